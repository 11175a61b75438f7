"""Bird's-eye-view rectangles around clusters: of least area, or along their visible sides."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numba import njit

# Search-based rectangle fitting with the closeness criterion (Zhang, Xu, Dong, Dolan, "Efficient
# L-Shape Fitting for Vehicle Detection Using Laser Scanners", IV 2017).
ANGLES = np.arange(90) * (np.pi / 180)
MIN_SIDE_DISTANCE_M = np.float32(0.01)  # d0: lower limit of a point's distance to its side


@njit(cache=True, nogil=True)
def _to_sortable(value):
    """Map the bits of a float32 to an integer with the same sort order (-0 equals 0), or back."""
    return value if value >= 0 else -(1 << 31) - value


def sort_by_cluster(
    xyz: np.ndarray, labels: np.ndarray, sizes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sort points by cluster, then x, then y, so that the boxes do not depend on their order.

    Args:
        xyz: (N, 3) float32 points in metres.
        labels: (N,) int32 cluster ids 1..K; 0 for points without a cluster.
        sizes: (K,) number of points of each cluster.

    Returns:
        x (M,) and y (M,) float32 of the points with a cluster; start (K + 1,), the index of the
        first point of each cluster.
    """
    start = np.concatenate([[0], np.cumsum(sizes)])
    keys = _make_keys(xyz, labels, start)
    for begin, end in pairwise(start.tolist()):
        keys[begin:end].sort()  # NumPy's sort is vectorized; Numba's takes seconds to compile
    x, y = _split_keys(keys)
    return x, y, start


@njit(cache=True, nogil=True)
def _make_keys(xyz, labels, start):
    """Return (M,) int64 sort keys of the points with a cluster, cluster after cluster.

    A key holds both x and y, because one number sorts faster than two.
    """
    next_slot = start[:-1].copy()
    keys = np.empty(start[-1], np.int64)
    bits = xyz.view(np.int32)
    for i in range(len(xyz)):
        k = labels[i] - 1
        if k >= 0:
            keys[next_slot[k]] = (_to_sortable(np.int64(bits[i, 0])) << 32) + _to_sortable(np.int64(bits[i, 1]))
            next_slot[k] += 1
    return keys


@njit(cache=True, nogil=True)
def _split_keys(keys):
    xy_bits = np.empty((2, len(keys)), np.int32)
    for i in range(len(keys)):
        high = (keys[i] + (1 << 31)) >> 32
        xy_bits[0, i] = _to_sortable(high)
        xy_bits[1, i] = _to_sortable(keys[i] - (high << 32))
    return xy_bits[0].view(np.float32), xy_bits[1].view(np.float32)


@njit(cache=True, nogil=True)
def fit_rectangles(x, y, start, l_shape):
    """Fit a rectangle to each cluster.

    Args:
        x: (M,) float32, see sort_by_cluster.
        y: (M,) float32.
        start: (K + 1,) index of the first point of each cluster.
        l_shape: align the rectangles with the visible sides instead of minimising their area.

    Returns:
        (K, 5) float64 [x y l w yaw] in metres and radians, l >= w.
    """
    rectangles = np.zeros((len(start) - 1, 5))
    for k in range(len(rectangles)):
        begin, end = start[k], start[k + 1]
        if begin == end:
            continue
        # Relative to the first point, so that float64 holds the differences exactly.
        x0, y0 = np.float64(x[begin]), np.float64(y[begin])
        hull = _compute_convex_hull(x[begin:end] - x0, y[begin:end] - y0)
        cos, sin = _find_min_area_direction(hull)
        low_u, high_u, low_v, high_v = _find_spans(hull, cos, sin)
        # In a narrower rectangle all points have the minimum distance to a side.
        if l_shape and min(high_u - low_u, high_v - low_v) > MIN_SIDE_DISTANCE_M:
            cos, sin = _find_closest_direction(x[begin:end] - x[begin], y[begin:end] - y[begin], hull)
            low_u, high_u, low_v, high_v = _find_spans(hull, cos, sin)
        u, v = (low_u + high_u) / 2, (low_v + high_v) / 2
        length, width = high_u - low_u, high_v - low_v
        rectangles[k, 0], rectangles[k, 1] = x0 + cos * u - sin * v, y0 + sin * u + cos * v
        if width > length:
            length, width = width, length
            cos, sin = -sin, cos
        rectangles[k, 2], rectangles[k, 3], rectangles[k, 4] = length, width, math.atan2(sin, cos)
    return rectangles


@njit(cache=True, nogil=True)
def _compute_convex_hull(x, y):
    """Return the corners (2, H) float64 of the convex hull, counter-clockwise (monotone chain).

    The points must be sorted by x, then y. Collinear points give two corners, coincident points one.
    """
    n = len(x)
    corners = np.empty((2, n + 1))
    count, min_count = 0, 0
    for step in range(2 * n - 1):
        if step == n:
            min_count = count - 1  # the lower side is complete; continue with the upper side
        i = step if step < n else 2 * n - 2 - step
        while count > min_count + 1:
            ax, ay = corners[0, count - 2], corners[1, count - 2]
            bx, by = corners[0, count - 1], corners[1, count - 1]
            if (bx - ax) * (y[i] - ay) - (by - ay) * (x[i] - ax) > 0:
                break
            count -= 1
        if count == 0 or x[i] != corners[0, count - 1] or y[i] != corners[1, count - 1]:
            corners[0, count], corners[1, count] = x[i], y[i]
            count += 1
    return corners[:, : max(count - 1, 1)]  # the last corner repeats the first


@njit(cache=True, nogil=True)
def _find_spans(hull, cos, sin):
    """Return the extent along (cos, sin) and across it: low_u, high_u, low_v, high_v."""
    low_u = low_v = np.inf
    high_u = high_v = -np.inf
    for i in range(hull.shape[1]):
        u = cos * hull[0, i] + sin * hull[1, i]
        v = cos * hull[1, i] - sin * hull[0, i]
        low_u, high_u = min(low_u, u), max(high_u, u)
        low_v, high_v = min(low_v, v), max(high_v, v)
    return low_u, high_u, low_v, high_v


@njit(cache=True, nogil=True)
def _find_min_area_direction(hull):
    """Find the direction (cos, sin) of the smallest rectangle around a hull (rotating calipers).

    One of its sides lies along an edge of the hull.
    """
    count = hull.shape[1]
    min_area, best_cos, best_sin = np.inf, 1.0, 0.0
    front = top = rear = 1 % count
    for i in range(count if count > 1 else 0):
        x, y = hull[0, i], hull[1, i]
        dx, dy = hull[0, (i + 1) % count] - x, hull[1, (i + 1) % count] - y
        cos, sin = dx / math.hypot(dx, dy), dy / math.hypot(dx, dy)
        front = _advance_corner(hull, front, cos, sin)
        top = _advance_corner(hull, top, -sin, cos)
        rear = _advance_corner(hull, rear if i else top, -cos, -sin)
        length = cos * (hull[0, front] - hull[0, rear]) + sin * (hull[1, front] - hull[1, rear])
        area = length * (cos * (hull[1, top] - y) - sin * (hull[0, top] - x))
        if area < min_area:
            min_area, best_cos, best_sin = area, cos, sin
    return best_cos, best_sin


@njit(cache=True, nogil=True)
def _advance_corner(hull, corner, cos, sin):
    """Return the first corner from `corner` on that is farthest along (cos, sin)."""
    height = cos * hull[0, corner] + sin * hull[1, corner]
    while True:
        next_corner = (corner + 1) % hull.shape[1]
        next_height = cos * hull[0, next_corner] + sin * hull[1, next_corner]
        if next_height <= height:
            return corner
        corner, height = next_corner, next_height


@njit(cache=True, nogil=True)
def _find_closest_direction(x, y, hull):
    """Find the direction (cos, sin) of the rectangle whose sides are closest to the points.

    x and y are (N,) float32.
    """
    mean_x, mean_y = x.mean(), y.mean()
    max_closeness, best_cos, best_sin = -np.inf, 1.0, 0.0
    for angle in ANGLES:
        cos, sin = math.cos(angle), math.sin(angle)
        low_u, high_u, low_v, high_v = _find_spans(hull, cos, sin)
        # Of two opposite sides, the one nearer to the mean has the smaller sum of squares.
        side_u = high_u if 2 * (cos * mean_x + sin * mean_y) > low_u + high_u else low_u
        side_v = high_v if 2 * (cos * mean_y - sin * mean_x) > low_v + high_v else low_v
        closeness = _compute_closeness(x, y, np.float32(cos), np.float32(sin), np.float32(side_u), np.float32(side_v))
        if closeness > max_closeness:
            max_closeness, best_cos, best_sin = closeness, cos, sin
    return best_cos, best_sin


@njit(cache=True, nogil=True, fastmath=True)
def _compute_closeness(x, y, cos, sin, side_u, side_v):
    """Sum 1 / distance to the nearer side. float32 and fastmath allow vectorisation."""
    total = np.float32(0)
    for i in range(len(x)):
        u = abs(cos * x[i] + sin * y[i] - side_u)
        v = abs(cos * y[i] - sin * x[i] - side_v)
        total += np.float32(1) / max(min(u, v), MIN_SIDE_DISTANCE_M)
    return total
