"""Boxes, their overlap, ranges, and a counting sort; frames as in types.py."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike


def wrap_angle(angle: ArrayLike) -> np.ndarray:
    """Return the same angle in [-pi, pi)."""
    wrapped = (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi
    return np.where(wrapped >= np.pi, -np.pi, wrapped)[()]  # values just below -pi round to pi


def wrap_line(angle: ArrayLike) -> np.ndarray:
    """Return the angle in [-pi/2, pi/2) of the same line, in either direction."""
    return wrap_angle(2 * np.asarray(angle)) / 2


def horizontal_range(xyz: np.ndarray) -> np.ndarray:
    """Return (N,) distance from the sensor in the x-y plane, in the dtype of xyz (N, >=2)."""
    return np.sqrt(xyz[:, 0] * xyz[:, 0] + xyz[:, 1] * xyz[:, 1])


def elevation_angles(xyz: np.ndarray) -> np.ndarray:
    """Return (N,) angle of points (N, >=3) above the horizon of the origin, in radians."""
    return np.asarray(np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1])))


def is_within(at: np.ndarray, low: ArrayLike, high: ArrayLike) -> np.ndarray:
    """Return (N,) bool: True where low <= x, y < high for points or boxes (N, >=2); False for NaN.

    Only x and y of low and high (>=2,) count.
    """
    flat, low, high = at[:, :2], np.asarray(low)[:2], np.asarray(high)[:2]
    return np.asarray(((flat >= low) & (flat < high)).all(axis=1))


def to_box_frame(xyz: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Transform points (N, 3) to the frame of box (7,), with x along its length."""
    cos, sin = np.cos(box[6]), np.sin(box[6])
    dx, dy = xyz[:, 0] - box[0], xyz[:, 1] - box[1]
    return np.stack([cos * dx + sin * dy, cos * dy - sin * dx, xyz[:, 2] - box[2]], axis=1)


def points_in_box(xyz: np.ndarray, box: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Return (N,) bool: True for points (N, >=3) inside box (7,) or on its faces.

    The box is enlarged by margin metres on every side.
    """
    half = np.asarray(box[3:6], np.float64) / 2 + margin
    inside = np.zeros(len(xyz), bool)
    near = np.flatnonzero(np.abs(xyz[:, 0] - np.float32(box[0])) <= np.hypot(*half[:2]) + 1e-3)
    inside[near] = (np.abs(to_box_frame(xyz[near], box)) <= half).all(axis=1)
    return inside


def points_in_boxes(xyz: np.ndarray, boxes: np.ndarray, margin: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Find the points (N, 3) inside each of the boxes (K, 7), as points_in_box does.

    A point can be in several boxes. The time grows with K * N: meant for detections.

    Returns:
        indices (M,) int64 of the points, those of box k in first[k]:first[k + 1], ascending; and
        first (K + 1,) int64.
    """
    boxes = np.ascontiguousarray(boxes, np.float32).reshape(-1, 7)
    xyz = np.ascontiguousarray(xyz[:, :3], np.float32)
    reach = np.hypot(boxes[:, 3] / 2.0 + margin, boxes[:, 4] / 2.0 + margin) + 1e-3
    begin, end = boxes[:, 0] - reach, boxes[:, 0] + reach
    low = max(_finite_min(begin), _finite_min(xyz[:, 0]), -MAX_DISTANCE_M)
    high = min(-_finite_min(-end), -_finite_min(-xyz[:, 0]), MAX_DISTANCE_M)
    inside, first = _points_in_boxes(xyz, boxes, margin, begin, end, low, high)
    offset = np.repeat(np.arange(len(boxes)) * len(xyz), np.diff(first))
    return np.sort(inside + offset) - offset, first


SLAB_COUNT = 256  # slabs across x in which the points of a box are searched
MAX_DISTANCE_M = 1e9  # no point is farther


def _finite_min(values: np.ndarray) -> float:
    """Return the smallest number that is not NaN, inf if there is none."""
    return float(np.fmin.reduce(values, initial=np.inf))


@njit(cache=True, nogil=True)
def counting_sort(keys, count, first):
    """Sort indices stably by their keys (N,), 0..count-1.

    Args:
        first: (N,) indices in the order that equal keys keep.

    Returns:
        order (N,), and start (count + 1,): the indices with key k are order[start[k]:start[k + 1]].
    """
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


# Numba takes seconds to compile NumPy's quantile, and half a second its searchsorted.
@njit(cache=True, nogil=True)
def quantile(values, share):
    """Return the value below which a share of finite numbers (N,) lies, N > 0, interpolated as by
    np.quantile. The numbers are reordered."""
    rank = share * (len(values) - 1)
    k, low, high = int(rank), 0, len(values) - 1
    while low < high:  # Hoare's selection
        i, j = _partition(values, low, high)
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            break
    if rank == k:
        return values[k]
    above = values[k + 1]
    for i in range(k + 2, len(values)):
        above = min(above, values[i])
    return values[k] + (above - values[k]) * (rank - k)


@njit(cache=True, nogil=True)
def _partition(values, low, high):
    """Reorder values low .. high; return i and j < i, so that those up to j are at most as large as
    those from i on, and those between are equal."""
    middle = (low + high) // 2
    a, pivot, c = values[low], values[middle], values[high]
    pivot = max(min(a, pivot), min(max(a, pivot), c))
    i, j = low, high
    while i <= j:
        while values[i] < pivot:
            i += 1
        while pivot < values[j]:
            j -= 1
        if i <= j:
            values[i], values[j] = values[j], values[i]
            i += 1
            j -= 1
    return i, j


@njit(cache=True, nogil=True)
def lower_bound(values, number):
    """Return how many of the ascending values (N,) are less than a number."""
    low, high = 0, len(values)
    while low < high:
        middle = (low + high) // 2
        if values[middle] < number:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True, nogil=True)
def _points_in_boxes(xyz, boxes, margin, begin, end, low, high):
    """Return points_in_boxes(), but the points of a box in any order."""
    scale = (SLAB_COUNT - 1) / max(high - low, 1e-3)
    slab = np.full(len(xyz), SLAB_COUNT)  # the last slab holds points that no box can contain
    for i in range(len(xyz)):
        if low <= xyz[i, 0] <= high:
            slab[i] = int((xyz[i, 0] - low) * scale)
    order, start = counting_sort(slab, SLAB_COUNT + 1, np.arange(len(xyz)))
    first, inside = np.zeros(len(boxes) + 1, np.int64), np.empty(len(order), np.int64)
    count = 0
    for k in range(len(boxes)):
        x, y, z, yaw = boxes[k, 0], boxes[k, 1], boxes[k, 2], boxes[k, 6]
        cos, sin = np.cos(yaw), np.sin(yaw)
        length, width = boxes[k, 3] / 2.0 + margin, boxes[k, 4] / 2.0 + margin
        height = boxes[k, 5] / 2.0 + margin
        left, right = max(begin[k], low), min(end[k], high)
        if left <= right:
            near = order[start[int((left - low) * scale)] : start[int((right - low) * scale) + 1]]
            if count + len(near) > len(inside):
                inside = np.concatenate((inside, np.empty(len(inside) + len(near), np.int64)))
            for i in near:
                dx, dy = xyz[i, 0] - x, xyz[i, 1] - y
                if (
                    abs(cos * dx + sin * dy) <= length
                    and abs(cos * dy - sin * dx) <= width
                    and abs(xyz[i, 2] - z) <= height
                ):
                    inside[count] = i
                    count += 1
        first[k + 1] = count
    return inside[:count].copy(), first


def centre_distances(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return (K, M) distance in x-y between the centres of boxes (K, 7) and others (M, 7)."""
    return np.hypot(*(boxes[:, None, :2] - others[None, :, :2]).transpose(2, 0, 1))


def box_corners(boxes: np.ndarray) -> np.ndarray:
    """Return the corners (K, 8, 3) of boxes (K, 7).

    The first four are at the bottom, counter-clockwise from front left seen from above; the other
    four are above them.
    """
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / 2
    flat = signs * boxes[:, None, 3:5]
    cos, sin = np.cos(boxes[:, None, 6]), np.sin(boxes[:, None, 6])
    x = boxes[:, None, 0] + cos * flat[..., 0] - sin * flat[..., 1]
    y = boxes[:, None, 1] + sin * flat[..., 0] + cos * flat[..., 1]
    half = boxes[:, None, 5] / 2
    below, above = (np.broadcast_to(boxes[:, None, 2] + s * half, x.shape) for s in (-1, 1))
    return np.concatenate([np.stack([x, y, below], -1), np.stack([x, y, above], -1)], axis=1)


MAX_CORNERS = 8  # of the overlap of two rectangles: clipping at four sides adds one corner each


def bev_and_3d_iou(boxes: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return BEV IoU and 3D IoU, each (K, M) float64 0..1, of boxes (K, 7) and others (M, 7).

    A box without area (BEV) or volume (3D), or with a value that is not finite, has IoU 0 with
    every box, also with itself.
    """
    return _compute_ious(_to_rows(boxes), _to_rows(others))


def bev_iou(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the BEV IoU (K, M) of bev_and_3d_iou."""
    return bev_and_3d_iou(boxes, others)[0]


def iou_3d(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the 3D IoU (K, M) of bev_and_3d_iou."""
    return bev_and_3d_iou(boxes, others)[1]


def _to_rows(boxes: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(boxes, np.float64).reshape(-1, 7)


@njit(cache=True, nogil=True)
def _compute_ious(boxes, others):
    bev = np.zeros((len(boxes), len(others)))
    space = np.zeros((len(boxes), len(others)))
    reach, other_reach = footprint_radii(boxes), footprint_radii(others)
    work = np.empty((4, MAX_CORNERS))
    for i in range(len(boxes)):
        a = boxes[i]
        area_a = a[3] * a[4]
        for j in range(len(others)):
            b = others[j]
            shared = overlap_area(a, b, reach[i] + other_reach[j], work)
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
def footprint_radii(boxes):
    """Return (K,) the distance of the corners of boxes (K, 7) from their centres in x-y.

    NaN for boxes without area or with a value that is not finite.
    """
    found = np.full(len(boxes), np.nan)
    for i in range(len(boxes)):
        if boxes[i, 3] > 0 and boxes[i, 4] > 0 and np.isfinite(boxes[i]).all():
            found[i] = math.hypot(boxes[i, 3], boxes[i, 4]) / 2
    return found


@njit(cache=True, nogil=True)
def overlap_area(a, b, reach, work):
    """Return the area of the overlap of two boxes (7,) in x-y.

    reach is the sum of their footprint radii; the area is 0 if it is NaN or the centres are farther
    apart. work (4, MAX_CORNERS) float64 is overwritten.
    """
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
    count = _clip(x, y, 4, 1.0, b[3] / 2, cut_x, cut_y)
    count = _clip(cut_x, cut_y, count, -1.0, b[3] / 2, x, y)
    count = _clip(y, x, count, 1.0, b[4] / 2, cut_y, cut_x)
    count = _clip(cut_y, cut_x, count, -1.0, b[4] / 2, y, x)
    area = 0.0
    for k in range(1, count - 1):
        area += (x[k] - x[0]) * (y[k + 1] - y[0]) - (x[k + 1] - x[0]) * (y[k] - y[0])
    return min(max(area / 2, 0.0), a[3] * a[4], b[3] * b[4])


@njit(cache=True, nogil=True)
def _clip(u, v, count, sign, limit, kept_u, kept_v):
    """Clip a convex polygon u, v with `count` corners to sign * u <= limit.

    Writes the corners to kept_u and kept_v and returns their number.
    """
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
