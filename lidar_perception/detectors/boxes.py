"""Boxes of a network put right by a second one, and by what is seen around them: the ground, and
the nearest points.

Two networks err differently. One that was trained on simulated scans places cars of real ones too
far away and not quite on the ground; the points say better where a face that is seen must be.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.classes import CAR
from lidar_perception.geometry import points_in_boxes, wrap_angle, wrap_line

MARGIN = 0.4   # metres around a box in which its points are looked for
ABOVE = 0.2    # metres above its bottom from which on points count
FEWEST = 30    # points of a face
SHARE = 0.03   # of the points of a face are in front of what is called its points' begin
# Where that is in a labelled box, metres behind the face: of 60 simulated scans.
FRONT, REAR, SIDE = 0.03, 0.03, -0.01
ASLANT = 0.3   # a face counts that is seen at no flatter an angle than this, as a tangent


def moved_towards(boxes: np.ndarray, others: np.ndarray, share: float) -> np.ndarray:
    """Boxes (K, 7) moved, turned and resized by this share, 0..1, of what they differ from others
    (K, 7) of the same objects; those whose other one is NaN stay. Which end is the front stays."""
    way = np.where(np.isfinite(others), others - boxes, 0.0)
    way[:, 6] = wrap_line(way[:, 6])
    moved = boxes + share * way
    moved[:, 6] = wrap_angle(moved[:, 6])
    return moved


def on_ground(boxes: np.ndarray, floors: np.ndarray, share: float) -> np.ndarray:
    """Boxes (K, 7) whose bottoms are moved by this share, 0..1, of the way to the ground under
    them, floors (K,) z; those with NaN stay."""
    moved = boxes.copy()
    way = share * (floors - (boxes[:, 2] - boxes[:, 5] / 2))
    moved[:, 2] += np.where(np.isfinite(way), way, 0.0)
    return moved


def cars_on_points(boxes: np.ndarray, class_ids: np.ndarray, xyz: np.ndarray,
                   share: float) -> np.ndarray:
    """Boxes (K, 7) float64, of which the cars, by class_ids (K,), are moved, see on_points."""
    moved, cars = np.array(boxes, np.float64), class_ids == CAR
    if share and cars.any():
        moved[cars] = on_points(moved[cars], xyz, share)
    return moved


def on_points(boxes: np.ndarray, xyz: np.ndarray, share: float) -> np.ndarray:
    """Boxes (K, 7) moved by this share, 0..1, of the way along their axes that brings the faces
    that a sensor at 0 sees to where the points (N, 3) begin; at most MARGIN, and a face with less
    than FEWEST of them stays."""
    indices, first = points_in_boxes(xyz, boxes, MARGIN)
    return _on_points(np.asarray(boxes, np.float64), xyz[indices].astype(np.float64), first, share)


@njit(cache=True, nogil=True)
def _on_points(boxes, points, first, share):
    moved = boxes.copy()
    for k in range(len(boxes)):
        x, y, z = boxes[k, :3]
        cos, sin = np.cos(boxes[k, 6]), np.sin(boxes[k, 6])
        sensor = np.array([-cos * x - sin * y, sin * x - cos * y])
        own = points[first[k]:first[k + 1]]
        own = own[own[:, 2] > z - boxes[k, 5] / 2 + ABOVE]
        flat = np.empty((len(own), 2))
        flat[:, 0] = cos * (own[:, 0] - x) + sin * (own[:, 1] - y)
        flat[:, 1] = cos * (own[:, 1] - y) - sin * (own[:, 0] - x)
        for axis in range(2):
            half, side = boxes[k, 3 + axis] / 2, np.sign(sensor[axis])
            if abs(sensor[axis]) <= half or abs(sensor[axis]) < ASLANT * abs(sensor[1 - axis]):
                continue
            face = flat[np.abs(flat[:, 1 - axis]) <= boxes[k, 4 - axis] / 2 + 0.1]
            if len(face) < FEWEST:
                continue
            begin = np.quantile(half - side * face[:, axis], SHARE)
            expected = SIDE if axis == 1 else (FRONT if side > 0 else REAR)
            way = -side * share * min(max(begin - expected, -MARGIN), MARGIN)
            moved[k, 0] += way * (cos if axis == 0 else -sin)
            moved[k, 1] += way * (sin if axis == 0 else cos)
    return moved
