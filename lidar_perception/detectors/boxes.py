"""Box refinement: move a network's boxes towards those of another network, the ground and the points.

Different networks make different errors. A network trained on simulated scans places real cars
slightly too far away and not exactly on the ground. Points locate the visible faces more precisely.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.classes import CAR
from lidar_perception.geometry import points_in_boxes, quantile, wrap_angle, wrap_line

MARGIN_M = 0.4  # points up to this distance outside a box belong to its object
MIN_HEIGHT_M = 0.2  # minimum height of a point above the bottom of its box; lower points may be ground
MIN_FACE_POINTS = 30  # minimum number of points on a face
FACE_QUANTILE = 0.03  # quantile of the point depths that represents the surface of a face
# Depth of this quantile behind the faces of labelled boxes, in metres, measured on 60 simulated scans.
FRONT_DEPTH, REAR_DEPTH, SIDE_DEPTH = 0.03, 0.03, -0.01
MIN_FACE_SLOPE = 0.3  # tangent of the minimum viewing angle of a face


def move_towards(boxes: np.ndarray, others: np.ndarray, weight: float) -> np.ndarray:
    """Interpolate between the boxes (K, 7) of two networks.

    Args:
        others: (K, 7) boxes of the same objects; a row with NaN leaves its box unchanged.
        weight: 0 returns `boxes`, 1 returns `others`, except that the front stays on the same side.
    """
    difference = np.where(np.isfinite(others), others - boxes, 0.0)
    difference[:, 6] = wrap_line(difference[:, 6])
    moved_boxes = boxes + weight * difference
    moved_boxes[:, 6] = wrap_angle(moved_boxes[:, 6])
    return moved_boxes


def move_to_ground(boxes: np.ndarray, ground_heights: np.ndarray, weight: float) -> np.ndarray:
    """Move boxes (K, 7) vertically towards the ground.

    Args:
        ground_heights: (K,) z of the ground below each box; a box with NaN is not moved.
        weight: 0 keeps the boxes, 1 moves their bottoms onto the ground.
    """
    moved_boxes = boxes.copy()
    offset = weight * (ground_heights - (boxes[:, 2] - boxes[:, 5] / 2))
    moved_boxes[:, 2] += np.where(np.isfinite(offset), offset, 0.0)
    return moved_boxes


def move_cars_to_points(boxes: np.ndarray, class_ids: np.ndarray, xyz: np.ndarray, weight: float) -> np.ndarray:
    """Apply move_to_points to the cars among boxes (K, 7), and return all boxes as float64."""
    moved_boxes, is_car = np.array(boxes, np.float64), class_ids == CAR
    if weight and is_car.any():
        moved_boxes[is_car] = move_to_points(moved_boxes[is_car], xyz, weight)
    return moved_boxes


def move_to_points(boxes: np.ndarray, xyz: np.ndarray, weight: float) -> np.ndarray:
    """Move boxes (K, 7) along their axes so that their visible faces fit the points (N, 3).

    The sensor is at the origin. Boxes move by at most MARGIN_M. A face with fewer than
    MIN_FACE_POINTS points does not move its box.

    Args:
        weight: 0 keeps the boxes, 1 moves their faces all the way to the points.
    """
    indices, first = points_in_boxes(xyz, boxes, MARGIN_M)
    return _move_to_points(np.asarray(boxes, np.float64), xyz[indices].astype(np.float64), first, weight)


@njit(cache=True, nogil=True)
def _move_to_points(boxes, points, first, weight):
    moved_boxes = boxes.copy()
    for k in range(len(boxes)):
        x, y, z = boxes[k, :3]
        cos, sin = np.cos(boxes[k, 6]), np.sin(boxes[k, 6])
        sensor_xy = np.array([-cos * x - sin * y, sin * x - cos * y])  # in the coordinates of the box
        box_points = points[first[k] : first[k + 1]]
        box_points = box_points[box_points[:, 2] > z - boxes[k, 5] / 2 + MIN_HEIGHT_M]
        box_xy = np.empty((len(box_points), 2))
        box_xy[:, 0] = cos * (box_points[:, 0] - x) + sin * (box_points[:, 1] - y)
        box_xy[:, 1] = cos * (box_points[:, 1] - y) - sin * (box_points[:, 0] - x)
        for axis in range(2):
            half_size, sign = boxes[k, 3 + axis] / 2, np.sign(sensor_xy[axis])
            if abs(sensor_xy[axis]) <= half_size or (abs(sensor_xy[axis]) < MIN_FACE_SLOPE * abs(sensor_xy[1 - axis])):
                continue
            face_xy = box_xy[np.abs(box_xy[:, 1 - axis]) <= boxes[k, 4 - axis] / 2 + 0.1]
            if len(face_xy) < MIN_FACE_POINTS:
                continue
            depth = quantile(half_size - sign * face_xy[:, axis], FACE_QUANTILE)
            expected_depth = SIDE_DEPTH if axis == 1 else (FRONT_DEPTH if sign > 0 else REAR_DEPTH)
            offset = -sign * weight * min(max(depth - expected_depth, -MARGIN_M), MARGIN_M)
            moved_boxes[k, 0] += offset * (cos if axis == 0 else -sin)
            moved_boxes[k, 1] += offset * (sin if axis == 0 else cos)
    return moved_boxes
