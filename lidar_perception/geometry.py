"""Geometry of boxes, points and angles, and sorting in compiled code; frames as in types.py."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike


def wrap_angle(angle: ArrayLike) -> np.ndarray:
    """Wrap an angle to [-pi, pi)."""
    wrapped = (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi
    return np.where(wrapped >= np.pi, -np.pi, wrapped)[()]  # values just below -pi round to pi


def wrap_line(angle: ArrayLike) -> np.ndarray:
    """Wrap the angle of a line, whose direction does not matter, to [-pi/2, pi/2)."""
    return wrap_angle(2 * np.asarray(angle)) / 2


def horizontal_range(xyz: np.ndarray) -> np.ndarray:
    """Return the distance (N,) in x-y from the origin to points (N, >=2), in the dtype of xyz."""
    return np.sqrt(xyz[:, 0] * xyz[:, 0] + xyz[:, 1] * xyz[:, 1])


def elevation_angles(xyz: np.ndarray) -> np.ndarray:
    """Return the elevation angle (N,) of points (N, >=3) as seen from the origin, in radians."""
    return np.asarray(np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1])))


def is_within(positions: np.ndarray, low: ArrayLike, high: ArrayLike) -> np.ndarray:
    """Return (N,) bool: True where low <= x, y < high; False for NaN.

    Args:
        positions: (N, >=2) points or boxes.
        low, high: (>=2,) limits, of which only x and y are used.
    """
    xy, low, high = positions[:, :2], np.asarray(low)[:2], np.asarray(high)[:2]
    return np.asarray(((xy >= low) & (xy < high)).all(axis=1))


def to_box_frame(xyz: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Transform points (N, 3) to the frame of box (7,), with x along its length."""
    cos, sin = np.cos(box[6]), np.sin(box[6])
    dx, dy = xyz[:, 0] - box[0], xyz[:, 1] - box[1]
    return np.stack([cos * dx + sin * dy, cos * dy - sin * dx, xyz[:, 2] - box[2]], axis=1)


def points_in_box(xyz: np.ndarray, box: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Return (N,) bool: True for points (N, >=3) inside box (7,) or on its faces.

    The box is enlarged by `margin` metres on every side.
    """
    half_size = np.asarray(box[3:6], np.float64) / 2 + margin
    inside = np.zeros(len(xyz), bool)
    candidates = np.flatnonzero(np.abs(xyz[:, 0] - np.float32(box[0])) <= np.hypot(*half_size[:2]) + 1e-3)
    inside[candidates] = (np.abs(to_box_frame(xyz[candidates], box)) <= half_size).all(axis=1)
    return inside


def points_in_boxes(xyz: np.ndarray, boxes: np.ndarray, margin: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Find the points (N, 3) inside each of the boxes (K, 7), as points_in_box does.

    A point can be in several boxes. The run time is proportional to K * N, so this function is
    meant for the boxes of one frame.

    Returns:
        indices: (M,) int64 indices of the points. Those of box k are
            indices[first[k]:first[k + 1]], ascending.
        first: (K + 1,) int64.
    """
    boxes = np.ascontiguousarray(boxes, np.float32).reshape(-1, 7)
    xyz = np.ascontiguousarray(xyz[:, :3], np.float32)
    radius = np.hypot(boxes[:, 3] / 2.0 + margin, boxes[:, 4] / 2.0 + margin) + 1e-3
    begin, end = boxes[:, 0] - radius, boxes[:, 0] + radius
    low = max(_finite_min(begin), _finite_min(xyz[:, 0]), -MAX_DISTANCE_M)
    high = min(-_finite_min(-end), -_finite_min(-xyz[:, 0]), MAX_DISTANCE_M)
    indices, first = _points_in_boxes(xyz, boxes, margin, begin, end, low, high)
    offset = np.repeat(np.arange(len(boxes)) * len(xyz), np.diff(first))
    return np.sort(indices + offset) - offset, first


SLAB_COUNT = 256  # number of slabs along x into which points are sorted to find those in a box
MAX_DISTANCE_M = 1e9  # maximum distance of a point along x


def _finite_min(values: np.ndarray) -> float:
    """Return the smallest value that is not NaN, or inf without such a value."""
    return float(np.fmin.reduce(values, initial=np.inf))


@njit(cache=True, nogil=True)
def counting_sort(keys, count, first):
    """Sort indices by their integer keys (stable counting sort).

    Args:
        keys: (N,) int, 0..count-1.
        count: number of possible keys.
        first: (N,) indices 0..N-1 in their initial order, which is kept among equal keys.

    Returns:
        order: (N,) sorted indices.
        start: (count + 1,); the indices with key k are order[start[k]:start[k + 1]].
    """
    start = np.zeros(count + 1, np.int64)
    for key in keys:
        start[key + 1] += 1
    for i in range(count):
        start[i + 1] += start[i]
    next_slot, order = start[:-1].copy(), np.empty(len(keys), np.int64)
    for i in first:
        order[next_slot[keys[i]]] = i
        next_slot[keys[i]] += 1
    return order, start


# Numba takes seconds to compile NumPy's quantile, and half a second its searchsorted.
@njit(cache=True, nogil=True)
def quantile(values, fraction):
    """Return a quantile of finite values (N,), N > 0, with the interpolation of np.quantile.

    The values are reordered in place.

    Args:
        fraction: level of the quantile, 0..1.
    """
    rank = fraction * (len(values) - 1)
    k, low, high = int(rank), np.int64(0), len(values) - 1
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
    next_value = values[k + 1]
    for i in range(k + 2, len(values)):
        next_value = min(next_value, values[i])
    return values[k] + (next_value - values[k]) * (rank - k)


@njit(cache=True, nogil=True)
def _partition(values, low, high):
    """Partition the values at indices low..high around a pivot (Hoare); return i and j, j < i.

    Values at indices up to j do not exceed those from i on, and all values in between are equal.
    """
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
    """Return how many of the ascending values (N,) are less than `number`."""
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
    """Compute the result of points_in_boxes(), but with the points of a box in any order."""
    scale = (SLAB_COUNT - 1) / max(high - low, 1e-3)
    slab = np.full(len(xyz), SLAB_COUNT)  # the last slab holds points that no box can contain
    for i in range(len(xyz)):
        if low <= xyz[i, 0] <= high:
            slab[i] = int((xyz[i, 0] - low) * scale)
    order, start = counting_sort(slab, SLAB_COUNT + 1, np.arange(len(xyz)))
    first, indices = np.zeros(len(boxes) + 1, np.int64), np.empty(len(order), np.int64)
    count = 0
    for k in range(len(boxes)):
        x, y, z, yaw = boxes[k, 0], boxes[k, 1], boxes[k, 2], boxes[k, 6]
        cos, sin = np.cos(yaw), np.sin(yaw)
        length, width = boxes[k, 3] / 2.0 + margin, boxes[k, 4] / 2.0 + margin
        height = boxes[k, 5] / 2.0 + margin
        low_x, high_x = max(begin[k], low), min(end[k], high)
        if low_x <= high_x:
            candidates = order[start[int((low_x - low) * scale)] : start[int((high_x - low) * scale) + 1]]
            if count + len(candidates) > len(indices):
                indices = np.concatenate((indices, np.empty(len(indices) + len(candidates), np.int64)))
            for i in candidates:
                dx, dy = xyz[i, 0] - x, xyz[i, 1] - y
                if (
                    abs(cos * dx + sin * dy) <= length
                    and abs(cos * dy - sin * dx) <= width
                    and abs(xyz[i, 2] - z) <= height
                ):
                    indices[count] = i
                    count += 1
        first[k + 1] = count
    return indices[:count].copy(), first


def centre_distances(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the distances (K, M) in x-y between the centres of boxes (K, 7) and others (M, 7)."""
    return np.hypot(*(boxes[:, None, :2] - others[None, :, :2]).transpose(2, 0, 1))


def box_corners(boxes: np.ndarray) -> np.ndarray:
    """Return the corners (K, 8, 3) of boxes (K, 7).

    The first four are at the bottom, counter-clockwise from the front left as seen from above. The
    other four are above them.
    """
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / 2
    offsets = signs * boxes[:, None, 3:5]
    cos, sin = np.cos(boxes[:, None, 6]), np.sin(boxes[:, None, 6])
    x = boxes[:, None, 0] + cos * offsets[..., 0] - sin * offsets[..., 1]
    y = boxes[:, None, 1] + sin * offsets[..., 0] + cos * offsets[..., 1]
    half_height = boxes[:, None, 5] / 2
    bottom, top = (np.broadcast_to(boxes[:, None, 2] + sign * half_height, x.shape) for sign in (-1, 1))
    return np.concatenate([np.stack([x, y, bottom], -1), np.stack([x, y, top], -1)], axis=1)


# Maximum corners of the overlap of two rectangles: clipping at each of four sides adds one corner to four.
MAX_CORNERS = 8


def bev_and_3d_iou(boxes: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return BEV IoU and 3D IoU, each (K, M) float64 0..1, of boxes (K, 7) and others (M, 7).

    A box that has no area (BEV) or no volume (3D), or a value that is not finite, has IoU 0 with
    all boxes, including itself.
    """
    return _compute_ious(_to_rows(boxes), _to_rows(others))


def bev_iou(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the BEV IoU (K, M) of boxes (K, 7) and others (M, 7), see bev_and_3d_iou."""
    return bev_and_3d_iou(boxes, others)[0]


def iou_3d(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the 3D IoU (K, M) of boxes (K, 7) and others (M, 7), see bev_and_3d_iou."""
    return bev_and_3d_iou(boxes, others)[1]


def _to_rows(boxes: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(boxes, np.float64).reshape(-1, 7)


@njit(cache=True, nogil=True)
def _compute_ious(boxes, others):
    bev_ious = np.zeros((len(boxes), len(others)))
    volume_ious = np.zeros((len(boxes), len(others)))
    radii, other_radii = footprint_radii(boxes), footprint_radii(others)
    buffer = np.empty((4, MAX_CORNERS))
    for i in range(len(boxes)):
        a = boxes[i]
        area_a = a[3] * a[4]
        for j in range(len(others)):
            b = others[j]
            overlap = overlap_area(a, b, radii[i] + other_radii[j], buffer)
            if overlap <= 0:
                continue
            area_b = b[3] * b[4]
            bev_ious[i, j] = overlap / (area_a + area_b - overlap)
            height = min(a[2] + a[5] / 2, b[2] + b[5] / 2) - max(a[2] - a[5] / 2, b[2] - b[5] / 2)
            height = min(height, a[5], b[5])
            if height > 0:
                volume = overlap * height
                volume_ious[i, j] = volume / (area_a * a[5] + area_b * b[5] - volume)
    return bev_ious, volume_ious


@njit(cache=True, nogil=True)
def footprint_radii(boxes):
    """Return the distance (K,) in x-y from the centre to the corners of each box (K, 7).

    The distance is NaN for a box that has no area or a value that is not finite.
    """
    radii = np.full(len(boxes), np.nan)
    for i in range(len(boxes)):
        if boxes[i, 3] > 0 and boxes[i, 4] > 0 and np.isfinite(boxes[i]).all():
            radii[i] = math.hypot(boxes[i, 3], boxes[i, 4]) / 2
    return radii


@njit(cache=True, nogil=True)
def overlap_area(a, b, max_distance, buffer):
    """Return the area in x-y where two boxes (7,) overlap.

    Args:
        max_distance: sum of their footprint radii. The area is 0 if it is NaN or the centres are
            farther apart.
        buffer: (4, MAX_CORNERS) float64, which is overwritten.
    """
    dx, dy = a[0] - b[0], a[1] - b[1]
    if not dx * dx + dy * dy < max_distance * max_distance:
        return 0.0
    x, y, cut_x, cut_y = buffer[0], buffer[1], buffer[2], buffer[3]
    cos, sin = math.cos(b[6]), math.sin(b[6])
    centre_x, centre_y = cos * dx + sin * dy, cos * dy - sin * dx
    cos, sin = math.cos(a[6] - b[6]), math.sin(a[6] - b[6])
    for k in range(4):
        local_x = a[3] / 2 if k == 0 or k == 3 else -a[3] / 2
        local_y = a[4] / 2 if k < 2 else -a[4] / 2
        x[k] = centre_x + cos * local_x - sin * local_y
        y[k] = centre_y + sin * local_x + cos * local_y
    count = _clip(x, y, np.int64(4), 1.0, b[3] / 2, cut_x, cut_y)
    count = _clip(cut_x, cut_y, count, -1.0, b[3] / 2, x, y)
    count = _clip(y, x, count, 1.0, b[4] / 2, cut_y, cut_x)
    count = _clip(cut_y, cut_x, count, -1.0, b[4] / 2, y, x)
    area = 0.0
    for k in range(1, count - 1):
        area += (x[k] - x[0]) * (y[k + 1] - y[0]) - (x[k + 1] - x[0]) * (y[k] - y[0])
    return min(max(area / 2, 0.0), a[3] * a[4], b[3] * b[4])


@njit(cache=True, nogil=True)
def _clip(u, v, count, sign, limit, clipped_u, clipped_v):
    """Clip a convex polygon u, v with `count` corners to sign * u <= limit.

    Writes the corners of the clipped polygon to clipped_u and clipped_v and returns their number.
    """
    clipped_count = 0
    for k in range(count):
        next_corner = k + 1 if k + 1 < count else 0
        distance, next_distance = sign * u[k] - limit, sign * u[next_corner] - limit
        if distance <= 0:
            clipped_u[clipped_count], clipped_v[clipped_count] = u[k], v[k]
            clipped_count += 1
        if (distance < 0 and next_distance > 0) or (distance > 0 and next_distance < 0):
            fraction = distance / (distance - next_distance)
            clipped_u[clipped_count] = sign * limit
            clipped_v[clipped_count] = v[k] + fraction * (v[next_corner] - v[k])
            clipped_count += 1
    return clipped_count
