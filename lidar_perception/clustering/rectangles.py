"""Rectangles around clusters seen from above: of least area, or along their visible sides."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

# Search-based rectangle fitting with the closeness criterion (Zhang, Xu, Dong, Dolan, "Efficient
# L-Shape Fitting for Vehicle Detection Using Laser Scanners", IV 2017).
ANGLES = np.arange(90) * (np.pi / 180)
CLOSEST = np.float32(0.01)  # m; d0: nearer to its side than this a point counts as this near


@njit(cache=True, nogil=True)
def _ordered(value):
    """The bits of a float32 to an integer that sorts as the number does (-0 as 0), and back."""
    return value if value >= 0 else -(1 << 31) - value


@njit(cache=True, nogil=True)
def grouped(xyz, labels, sizes):
    """x (M,), y (M,) float32 of all clusters' points, cluster by cluster, each ascending by x,
    then y; and start (K+1,). Sorted, the points give the same box in whatever order they came."""
    start = np.zeros(len(sizes) + 1, np.int64)
    start[1:] = np.cumsum(sizes)
    place = start[:-1].copy()
    keys = np.empty(start[-1], np.int64)  # x and y in one number: faster to sort than two
    bits = xyz.view(np.int32)
    for i in range(len(xyz)):
        k = labels[i] - 1
        if k >= 0:
            keys[place[k]] = (_ordered(np.int64(bits[i, 0])) << 32) + _ordered(np.int64(bits[i, 1]))
            place[k] += 1
    for k in range(len(sizes)):
        keys[start[k]:start[k + 1]].sort()
    flat = np.empty((2, len(keys)), np.int32)
    for i in range(len(keys)):
        high = (keys[i] + (1 << 31)) >> 32
        flat[0, i] = _ordered(high)
        flat[1, i] = _ordered(keys[i] - (high << 32))
    return flat[0].view(np.float32), flat[1].view(np.float32), start


@njit(cache=True, nogil=True)
def rectangles(x, y, start, l_shape):
    """(K, 5) float64 [x y l w yaw], l >= w, of clusters as grouped gives them."""
    rows = np.zeros((len(start) - 1, 5))
    for k in range(len(rows)):
        begin, end = start[k], start[k + 1]
        if begin == end:
            continue
        # Relative to one of the points: float64 then holds every difference that matters.
        x0, y0 = np.float64(x[begin]), np.float64(y[begin])
        hull = _hull(x[begin:end] - x0, y[begin:end] - y0)
        cos, sin = _smallest_direction(hull)
        low_u, high_u, low_v, high_v = _spans(hull, cos, sin)
        # In a rectangle narrower than CLOSEST the points are as close to the sides as can be.
        if l_shape and min(high_u - low_u, high_v - low_v) > CLOSEST:
            cos, sin = _closest_direction(x[begin:end] - x[begin], y[begin:end] - y[begin], hull)
            low_u, high_u, low_v, high_v = _spans(hull, cos, sin)
        u, v = (low_u + high_u) / 2, (low_v + high_v) / 2
        length, width = high_u - low_u, high_v - low_v
        rows[k, 0], rows[k, 1] = x0 + cos * u - sin * v, y0 + sin * u + cos * v
        if width > length:
            length, width = width, length
            cos, sin = -sin, cos
        rows[k, 2], rows[k, 3], rows[k, 4] = length, width, math.atan2(sin, cos)
    return rows


@njit(cache=True, nogil=True)
def _hull(x, y):
    """(2, H) float64 corners of the convex hull, counter-clockwise, of points ascending by x,
    then y (Andrew's monotone chain). Points on a line give its 2 ends, equal points 1."""
    n = len(x)
    corners = np.empty((2, n + 1))
    count, floor = 0, 0
    for step in range(2 * n - 1):
        if step == n:
            floor = count - 1  # back over the upper side; the lower stays
        i = step if step < n else 2 * n - 2 - step
        while count > floor + 1:
            ax, ay = corners[0, count - 2], corners[1, count - 2]
            bx, by = corners[0, count - 1], corners[1, count - 1]
            if (bx - ax) * (y[i] - ay) - (by - ay) * (x[i] - ax) > 0:
                break
            count -= 1
        if count == 0 or x[i] != corners[0, count - 1] or y[i] != corners[1, count - 1]:
            corners[0, count], corners[1, count] = x[i], y[i]
            count += 1
    return corners[:, :max(count - 1, 1)]  # the last is the first again


@njit(cache=True, nogil=True)
def _spans(hull, cos, sin):
    """Least and greatest coordinate of the hull along (cos, sin), and across it."""
    low_u = low_v = np.inf
    high_u = high_v = -np.inf
    for i in range(hull.shape[1]):
        u = cos * hull[0, i] + sin * hull[1, i]
        v = cos * hull[1, i] - sin * hull[0, i]
        low_u, high_u = min(low_u, u), max(high_u, u)
        low_v, high_v = min(low_v, v), max(high_v, v)
    return low_u, high_u, low_v, high_v


@njit(cache=True, nogil=True)
def _smallest_direction(hull):
    """(cos, sin) of the rectangle of least area around a hull. One of its sides lies along an edge
    of the hull, so one turn of the calipers sees it."""
    count = hull.shape[1]
    best, best_cos, best_sin = np.inf, 1.0, 0.0
    front = top = rear = 1 % count
    for i in range(count if count > 1 else 0):
        x, y = hull[0, i], hull[1, i]
        dx, dy = hull[0, (i + 1) % count] - x, hull[1, (i + 1) % count] - y
        cos, sin = dx / math.hypot(dx, dy), dy / math.hypot(dx, dy)
        front = _climbed(hull, front, cos, sin)
        top = _climbed(hull, top, -sin, cos)
        rear = _climbed(hull, rear if i else top, -cos, -sin)
        along = cos * (hull[0, front] - hull[0, rear]) + sin * (hull[1, front] - hull[1, rear])
        area = along * (cos * (hull[1, top] - y) - sin * (hull[0, top] - x))
        if area < best:
            best, best_cos, best_sin = area, cos, sin
    return best_cos, best_sin


@njit(cache=True, nogil=True)
def _climbed(hull, corner, cos, sin):
    """The corner from which the next ones no longer go on along (cos, sin)."""
    here = cos * hull[0, corner] + sin * hull[1, corner]
    while True:
        following = (corner + 1) % hull.shape[1]
        there = cos * hull[0, following] + sin * hull[1, following]
        if there <= here:
            return corner
        corner, here = following, there


@njit(cache=True, nogil=True)
def _closest_direction(x, y, hull):
    """(cos, sin) of the rectangle whose sides points x, y (N,) float32 lie closest to."""
    mean_x, mean_y = x.mean(), y.mean()
    best, best_cos, best_sin = -np.inf, 1.0, 0.0
    for angle in ANGLES:
        cos, sin = math.cos(angle), math.sin(angle)
        low_u, high_u, low_v, high_v = _spans(hull, cos, sin)
        # Of two opposite sides the one nearer to the mean has the smaller sum of squares.
        side_u = high_u if 2 * (cos * mean_x + sin * mean_y) > low_u + high_u else low_u
        side_v = high_v if 2 * (cos * mean_y - sin * mean_x) > low_v + high_v else low_v
        closeness = _closeness(x, y, np.float32(cos), np.float32(sin), np.float32(side_u),
                               np.float32(side_v))
        if closeness > best:
            best, best_cos, best_sin = closeness, cos, sin
    return best_cos, best_sin


@njit(cache=True, nogil=True, fastmath=True)
def _closeness(x, y, cos, sin, side_u, side_v):
    """Sum of 1 / distance to the nearer side. float32 and fastmath: eight points at a time."""
    total = np.float32(0)
    for i in range(len(x)):
        u = abs(cos * x[i] + sin * y[i] - side_u)
        v = abs(cos * y[i] - sin * x[i] - side_v)
        total += np.float32(1) / max(min(u, v), CLOSEST)
    return total
