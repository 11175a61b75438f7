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
    """Return the distance (N,) of points (N, >=2) from the sensor in x-y, in the dtype of xyz."""
    return np.sqrt(xyz[:, 0] * xyz[:, 0] + xyz[:, 1] * xyz[:, 1])


def elevation_angles(xyz: np.ndarray) -> np.ndarray:
    """Return the elevation angle (N,) of points (N, >=3) as seen from the origin, in radians."""
    return np.asarray(np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1])))


def is_within(at: np.ndarray, low: ArrayLike, high: ArrayLike) -> np.ndarray:
    """Return (N,) bool: True where low <= x, y < high for points or boxes (N, >=2); False for NaN.

    Only x and y of low and high (>=2,) are used.
    """
    xy, low, high = at[:, :2], np.asarray(low)[:2], np.asarray(high)[:2]
    return np.asarray(((xy >= low) & (xy < high)).all(axis=1))


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
    candidates = np.flatnonzero(np.abs(xyz[:, 0] - np.float32(box[0])) <= np.hypot(*half[:2]) + 1e-3)
    inside[candidates] = (np.abs(to_box_frame(xyz[candidates], box)) <= half).all(axis=1)
    return inside


def points_in_boxes(xyz: np.ndarray, boxes: np.ndarray, margin: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Find the points (N, 3) inside each of the boxes (K, 7), as points_in_box does.

    A point can be in several boxes. The time is proportional to K * N, so this is meant for the
    boxes of one frame.

    Returns:
        indices (M,) int64 of the points; those of box k are indices[first[k]:first[k + 1]],
        ascending.
        first (K + 1,) int64.
    """
    boxes = np.ascontiguousarray(boxes, np.float32).reshape(-1, 7)
    xyz = np.ascontiguousarray(xyz[:, :3], np.float32)
    reach = np.hypot(boxes[:, 3] / 2.0 + margin, boxes[:, 4] / 2.0 + margin) + 1e-3
    begin, end = boxes[:, 0] - reach, boxes[:, 0] + reach
    low = max(_finite_min(begin), _finite_min(xyz[:, 0]), -MAX_DISTANCE_M)
    high = min(-_finite_min(-end), -_finite_min(-xyz[:, 0]), MAX_DISTANCE_M)
    indices, first = _points_in_boxes(xyz, boxes, margin, begin, end, low, high)
    offset = np.repeat(np.arange(len(boxes)) * len(xyz), np.diff(first))
    return np.sort(indices + offset) - offset, first


SLAB_COUNT = 256  # slabs across x in which the points of a box are searched
MAX_DISTANCE_M = 1e9  # no point is farther


def _finite_min(values: np.ndarray) -> float:
    """Return the smallest value that is not NaN, inf if there is none."""
    return float(np.fmin.reduce(values, initial=np.inf))


@njit(cache=True, nogil=True)
def counting_sort(keys, count, first):
    """Sort indices stably by their keys (N,), 0..count-1.

    Args:
        keys: (N,) int.
        count: number of possible keys.
        first: (N,) indices 0..N-1 in their initial order, which is kept among equal keys.

    Returns:
        order (N,) and start (count + 1,): the indices with key k are order[start[k]:start[k + 1]].
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
    """Return the quantile of finite values (N,), N > 0, interpolated as by np.quantile.

    The values are reordered in place. fraction is 0..1.
    """
    rank = fraction * (len(values) - 1)
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
    next_value = values[k + 1]
    for i in range(k + 2, len(values)):
        next_value = min(next_value, values[i])
    return values[k] + (next_value - values[k]) * (rank - k)


@njit(cache=True, nogil=True)
def _partition(values, low, high):
    """Partition values low..high around a pivot (Hoare); return i and j, j < i.

    No value up to j exceeds a value from i on, and all values between j and i are equal.
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
    """Return the number of values that are less than `number`; values (N,) must be ascending."""
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
    """Return the result of points_in_boxes(), with the points of a box in any order."""
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
    half = boxes[:, None, 5] / 2
    below, above = (np.broadcast_to(boxes[:, None, 2] + s * half, x.shape) for s in (-1, 1))
    return np.concatenate([np.stack([x, y, below], -1), np.stack([x, y, above], -1)], axis=1)


MAX_CORNERS = 8  # maximum corners where two rectangles overlap: clipping at four sides adds one corner each


def bev_and_3d_iou(boxes: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return BEV IoU and 3D IoU, each (K, M) float64 0..1, of boxes (K, 7) and others (M, 7).

    A box without area (BEV) or volume (3D), or with a value that is not finite, has IoU 0 with all
    boxes, including itself.
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
    bev_ious = np.zeros((len(boxes), len(others)))
    volume_ious = np.zeros((len(boxes), len(others)))
    reach, other_reach = footprint_radii(boxes), footprint_radii(others)
    work = np.empty((4, MAX_CORNERS))
    for i in range(len(boxes)):
        a = boxes[i]
        area_a = a[3] * a[4]
        for j in range(len(others)):
            b = others[j]
            overlap = overlap_area(a, b, reach[i] + other_reach[j], work)
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
    """Return the distance (K,) of the corners of boxes (K, 7) from their centres in x-y.

    It is NaN for boxes without area or with a value that is not finite.
    """
    radii = np.full(len(boxes), np.nan)
    for i in range(len(boxes)):
        if boxes[i, 3] > 0 and boxes[i, 4] > 0 and np.isfinite(boxes[i]).all():
            radii[i] = math.hypot(boxes[i, 3], boxes[i, 4]) / 2
    return radii


@njit(cache=True, nogil=True)
def overlap_area(a, b, reach, work):
    """Return the area in x-y where two boxes (7,) overlap.

    Args:
        reach: sum of their footprint radii. The area is 0 if reach is NaN or the centres are
            farther apart.
        work: (4, MAX_CORNERS) float64 buffer, which is overwritten.
    """
    dx, dy = a[0] - b[0], a[1] - b[1]
    if not dx * dx + dy * dy < reach * reach:
        return 0.0
    x, y, cut_x, cut_y = work[0], work[1], work[2], work[3]
    cos, sin = math.cos(b[6]), math.sin(b[6])
    centre_x, centre_y = cos * dx + sin * dy, cos * dy - sin * dx
    cos, sin = math.cos(a[6] - b[6]), math.sin(a[6] - b[6])
    for k in range(4):
        local_x = a[3] / 2 if k == 0 or k == 3 else -a[3] / 2
        local_y = a[4] / 2 if k < 2 else -a[4] / 2
        x[k] = centre_x + cos * local_x - sin * local_y
        y[k] = centre_y + sin * local_x + cos * local_y
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

    Writes the remaining corners to kept_u and kept_v and returns their number.
    """
    kept_count = 0
    for k in range(count):
        next_corner = k + 1 if k + 1 < count else 0
        distance, next_distance = sign * u[k] - limit, sign * u[next_corner] - limit
        if distance <= 0:
            kept_u[kept_count], kept_v[kept_count] = u[k], v[k]
            kept_count += 1
        if (distance < 0 and next_distance > 0) or (distance > 0 and next_distance < 0):
            fraction = distance / (distance - next_distance)
            kept_u[kept_count] = sign * limit
            kept_v[kept_count] = v[k] + fraction * (v[next_corner] - v[k])
            kept_count += 1
    return kept_count
