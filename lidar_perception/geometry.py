"""Boxes, ranges, and a counting sort; frames as in types.py."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike


def wrap_angle(angle: ArrayLike) -> np.ndarray:
    """The same angle in [-pi, pi)."""
    wrapped = (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi
    return np.where(wrapped >= np.pi, -np.pi, wrapped)[()]  # a hair below -pi rounds to pi


def wrap_line(angle: ArrayLike) -> np.ndarray:
    """The angle in [-pi/2, pi/2) of the same line, either way along it."""
    return wrap_angle(2 * np.asarray(angle)) / 2


def horizontal_range(xyz: np.ndarray) -> np.ndarray:
    """(N,) distance from the sensor in the x-y plane, dtype of xyz. xyz is (N, >=2)."""
    return np.sqrt(xyz[:, 0] * xyz[:, 0] + xyz[:, 1] * xyz[:, 1])


def elevations(xyz: np.ndarray) -> np.ndarray:
    """(N,) radians above the horizon of the origin, of points (N, >=3)."""
    return np.asarray(np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1])))


def within(at: np.ndarray, low: ArrayLike, high: ArrayLike) -> np.ndarray:
    """(N,) bool: whether x and y of points, or of boxes, (N, >=2) are at least low and less than
    high, of which x and y count, too; not what is NaN."""
    flat, low, high = at[:, :2], np.asarray(low)[:2], np.asarray(high)[:2]
    return np.asarray(((flat >= low) & (flat < high)).all(axis=1))


def to_box_frame(xyz: np.ndarray, box: np.ndarray) -> np.ndarray:
    """(N, 3) points relative to the centre of box (7,), rotated so that x runs along its length."""
    cos, sin = np.cos(box[6]), np.sin(box[6])
    dx, dy = xyz[:, 0] - box[0], xyz[:, 1] - box[1]
    return np.stack([cos * dx + sin * dy, cos * dy - sin * dx, xyz[:, 2] - box[2]], axis=1)


def points_in_box(xyz: np.ndarray, box: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """(N,) bool: points (N, 3 or more) inside box (7,) grown by margin metres on every side; faces
    count."""
    half = np.asarray(box[3:6], np.float64) / 2 + margin
    inside = np.zeros(len(xyz), bool)
    near = np.flatnonzero(np.abs(xyz[:, 0] - np.float32(box[0])) <= np.hypot(*half[:2]) + 1e-3)
    inside[near] = (np.abs(to_box_frame(xyz[near], box)) <= half).all(axis=1)
    return inside


def points_in_boxes(xyz: np.ndarray, boxes: np.ndarray,
                    margin: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """points_in_box of every box (K, 7) at once: indices (M,) int64 of points (N, 3), those of box
    k from first[k] to first[k + 1], ascending, and first (K + 1,) int64. A point can be in
    several. Time grows with K times N, so K is of detections, not of points."""
    boxes = np.ascontiguousarray(boxes, np.float32).reshape(-1, 7)
    xyz = np.ascontiguousarray(xyz[:, :3], np.float32)
    reach = np.hypot(boxes[:, 3] / 2.0 + margin, boxes[:, 4] / 2.0 + margin) + 1e-3
    begin, end = boxes[:, 0] - reach, boxes[:, 0] + reach
    low = max(_lowest(begin), _lowest(xyz[:, 0]), -FAR)
    high = min(-_lowest(-end), -_lowest(-xyz[:, 0]), FAR)
    return _points_in_boxes(xyz, boxes, margin, begin, end, low, high)


SLABS = 256  # across x, between low and high, in which the points of a box are looked for
FAR = 1e9    # m: nothing is


def _lowest(values: np.ndarray) -> float:
    """The least that is a number, inf where there is none."""
    return float(np.fmin.reduce(values, initial=np.inf))


@njit(cache=True, nogil=True)
def stable_order(keys, count, first):
    """order (N,): `first` reordered by keys (N,) 0..count-1, equal keys keep their order; and start
    (count + 1,): those of key k are from start[k] to start[k + 1]. Counting sort."""
    start = np.zeros(count + 1, np.int64)
    for key in keys:
        start[key + 1] += 1
    for i in range(count):
        start[i + 1] += start[i]
    place, order = start[:-1].copy(), np.empty(len(keys), np.int64)
    for i in first:
        order[place[keys[i]]] = i
        place[keys[i]] += 1
    return order, start


@njit(cache=True, nogil=True)
def _points_in_boxes(xyz, boxes, margin, begin, end, low, high):
    scale = (SLABS - 1) / max(high - low, 1e-3)
    slab = np.full(len(xyz), SLABS)  # of what no box can hold, too
    for i in range(len(xyz)):
        if low <= xyz[i, 0] <= high:
            slab[i] = int((xyz[i, 0] - low) * scale)
    order, start = stable_order(slab, SLABS + 1, np.arange(len(xyz)))
    first, inside = np.zeros(len(boxes) + 1, np.int64), np.empty(len(order), np.int64)
    count = 0
    for k in range(len(boxes)):
        x, y, z, yaw = boxes[k, 0], boxes[k, 1], boxes[k, 2], boxes[k, 6]
        cos, sin = np.cos(yaw), np.sin(yaw)
        length, width = boxes[k, 3] / 2.0 + margin, boxes[k, 4] / 2.0 + margin
        height = boxes[k, 5] / 2.0 + margin
        left, right = max(begin[k], low), min(end[k], high)
        if left <= right:
            some = order[start[int((left - low) * scale)]:start[int((right - low) * scale) + 1]]
            if count + len(some) > len(inside):
                inside = np.concatenate((inside, np.empty(len(inside) + len(some), np.int64)))
            for i in some:
                dx, dy = xyz[i, 0] - x, xyz[i, 1] - y
                if (abs(cos * dx + sin * dy) <= length and abs(cos * dy - sin * dx) <= width
                        and abs(xyz[i, 2] - z) <= height):
                    inside[count] = i
                    count += 1
        first[k + 1] = count
        inside[first[k]:count].sort()
    return inside[:count].copy(), first


def centre_distances(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(K, M) metres from above between the centres of boxes (K, 7) and others (M, 7)."""
    return np.hypot(*(boxes[:, None, :2] - others[None, :, :2]).transpose(2, 0, 1))


def box_corners(boxes: np.ndarray) -> np.ndarray:
    """(K, 8, 3) corners of boxes (K, 7): four at the bottom, counter-clockwise from front left
    (seen from above), then the four above them."""
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / 2
    flat = signs * boxes[:, None, 3:5]
    cos, sin = np.cos(boxes[:, None, 6]), np.sin(boxes[:, None, 6])
    x = boxes[:, None, 0] + cos * flat[..., 0] - sin * flat[..., 1]
    y = boxes[:, None, 1] + sin * flat[..., 0] + cos * flat[..., 1]
    half = boxes[:, None, 5] / 2
    below, above = (np.broadcast_to(boxes[:, None, 2] + s * half, x.shape) for s in (-1, 1))
    return np.concatenate([np.stack([x, y, below], -1), np.stack([x, y, above], -1)], axis=1)


MAX_CORNERS = 8  # of what two rectangles share; four cuts add one corner each


def bev_and_3d_iou(boxes: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two (K, M) float64, 0..1: IoU seen from above and in space of boxes (K, 7) and others
    (M, 7), [x y z l w h yaw] with z up. A box without area (without volume, in space), or with a
    number that is not finite, overlaps nothing, not even itself."""
    return _ious(_rows(boxes), _rows(others))


def bev_iou(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(K, M) float64, 0..1: IoU seen from above, as in bev_and_3d_iou."""
    return bev_and_3d_iou(boxes, others)[0]


def iou_3d(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(K, M) float64, 0..1: IoU in space, as in bev_and_3d_iou."""
    return bev_and_3d_iou(boxes, others)[1]


def _rows(boxes: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(boxes, np.float64).reshape(-1, 7)


@njit(cache=True, nogil=True)
def _ious(boxes, others):
    bev = np.zeros((len(boxes), len(others)))
    space = np.zeros((len(boxes), len(others)))
    reach, other_reach = reaches(boxes), reaches(others)
    work = np.empty((4, MAX_CORNERS))
    for i in range(len(boxes)):
        a = boxes[i]
        area_a = a[3] * a[4]
        for j in range(len(others)):
            b = others[j]
            shared = shared_area(a, b, reach[i] + other_reach[j], work)
            if shared <= 0:
                continue
            area_b = b[3] * b[4]
            bev[i, j] = shared / (area_a + area_b - shared)
            height = min(a[2] + a[5] / 2, b[2] + b[5] / 2) - max(a[2] - a[5] / 2, b[2] - b[5] / 2)
            height = min(height, a[5], b[5])
            if height > 0:
                volume = shared * height
                space[i, j] = volume / (area_a * a[5] + area_b * b[5] - volume)
    return bev, space


@njit(cache=True, nogil=True)
def reaches(boxes):
    """(K,) how far the corners of boxes (K, 7) are from their centres, from above; NaN where a
    length or width is not above 0 or a number not finite."""
    found = np.full(len(boxes), np.nan)
    for i in range(len(boxes)):
        if boxes[i, 3] > 0 and boxes[i, 4] > 0 and np.isfinite(boxes[i]).all():
            found[i] = math.hypot(boxes[i, 3], boxes[i, 4]) / 2
    return found


@njit(cache=True, nogil=True)
def shared_area(a, b, reach, work):
    """Area that two boxes (7,) share from above; 0 where their centres are not within reach, the
    sum of their reaches, or this is NaN. work (4, MAX_CORNERS) float64 is overwritten."""
    dx, dy = a[0] - b[0], a[1] - b[1]
    if not dx * dx + dy * dy < reach * reach:
        return 0.0
    x, y, cut_x, cut_y = work[0], work[1], work[2], work[3]
    cos, sin = math.cos(b[6]), math.sin(b[6])
    centre_x, centre_y = cos * dx + sin * dy, cos * dy - sin * dx
    cos, sin = math.cos(a[6] - b[6]), math.sin(a[6] - b[6])
    for k in range(4):
        along = a[3] / 2 if k == 0 or k == 3 else -a[3] / 2
        across = a[4] / 2 if k < 2 else -a[4] / 2
        x[k] = centre_x + cos * along - sin * across
        y[k] = centre_y + sin * along + cos * across
    count = _cut(x, y, 4, 1.0, b[3] / 2, cut_x, cut_y)
    count = _cut(cut_x, cut_y, count, -1.0, b[3] / 2, x, y)
    count = _cut(y, x, count, 1.0, b[4] / 2, cut_y, cut_x)
    count = _cut(cut_y, cut_x, count, -1.0, b[4] / 2, y, x)
    area = 0.0
    for k in range(1, count - 1):
        area += (x[k] - x[0]) * (y[k + 1] - y[0]) - (x[k + 1] - x[0]) * (y[k] - y[0])
    return min(max(area / 2, 0.0), a[3] * a[4], b[3] * b[4])


@njit(cache=True, nogil=True)
def _cut(u, v, count, sign, limit, kept_u, kept_v):
    """The part of a convex polygon u, v (count corners) where sign * u <= limit, into kept_u and
    kept_v; returns the number of its corners."""
    kept = 0
    for k in range(count):
        following = k + 1 if k + 1 < count else 0
        here, there = sign * u[k] - limit, sign * u[following] - limit
        if here <= 0:
            kept_u[kept], kept_v[kept] = u[k], v[k]
            kept += 1
        if (here < 0 and there > 0) or (here > 0 and there < 0):
            share = here / (here - there)
            kept_u[kept] = sign * limit
            kept_v[kept] = v[k] + share * (v[following] - v[k])
            kept += 1
    return kept
