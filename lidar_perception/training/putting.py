"""Compiled parts of putting an object among points: what is inside a box, below it, before and
behind it."""

from __future__ import annotations

import numpy as np
from numba import njit

TOUCH = 1e-3         # m: nothing is nearer to the sensor


@njit(cache=True, nogil=True)
def inside(points: np.ndarray, box: np.ndarray, margin: float) -> np.ndarray:
    """Rising indices (K,) int64 of the points (N, 3 or more) inside box (7,) float64, grown by
    margin, metres. As geometry.points_in_box, four times as fast."""
    found, count = np.empty(len(points), np.int64), 0
    cos, sin = np.cos(box[6]), np.sin(box[6])
    half = box[3:6] / 2 + margin
    for i in range(len(points)):
        if _within(points[i], box, half, cos, sin):
            found[count] = i
            count += 1
    return found[:count].copy()


@njit(inline="always")
def _within(point, box, half, cos, sin):
    dx, dy = point[0] - box[0], point[1] - box[1]
    return (abs(cos * dx + sin * dy) <= half[0] and abs(cos * dy - sin * dx) <= half[1]
            and abs(point[2] - box[2]) <= half[2])


@njit(cache=True, nogil=True)
def put_among(points: np.ndarray, own: np.ndarray, box: np.ndarray, margin: float,
              most: float) -> np.ndarray:
    """points (N, 4) float32 without those in box (7,) float64, grown by margin, and those that the
    sensor sees behind the object, and after them the object's own (K, 4).

    None (0, 4) if it sees more than `most` points before the object.
    """
    bearing = np.arctan2(box[1], box[0])
    cos, sin = np.cos(bearing), np.sin(bearing)
    least, greatest = np.full(3, np.inf), np.full(3, -np.inf)  # depth, slopes aside and upwards
    for i in range(len(own)):
        depth = max(cos * own[i, 0] + sin * own[i, 1], TOUCH)
        for k, value in enumerate((depth, (cos * own[i, 1] - sin * own[i, 0]) / depth,
                                   own[i, 2] / depth)):
            least[k], greatest[k] = min(least[k], value), max(greatest[k], value)
    half, yaw_cos, yaw_sin = box[3:6] / 2 + margin, np.cos(box[6]), np.sin(box[6])
    out = np.empty((len(points) + len(own), 4), np.float32)
    count, before = 0, 0
    for i in range(len(points)):
        depth = cos * points[i, 0] + sin * points[i, 1]
        if depth > 0 and not least[0] <= depth <= greatest[0]:
            aside = cos * points[i, 1] - sin * points[i, 0]
            if (least[1] * depth <= aside <= greatest[1] * depth
                    and least[2] * depth <= points[i, 2] <= greatest[2] * depth):
                if depth > greatest[0]:
                    continue
                before += 1
        if not _within(points[i], box, half, yaw_cos, yaw_sin):
            for k in range(4):
                out[count, k] = points[i, k]
            count += 1
    if before > most:
        return out[:0]
    out[count:count + len(own)] = own
    return out[:count + len(own)]


@njit(cache=True, nogil=True)
def floor_under(points: np.ndarray, box: np.ndarray, reach: float, share: float) -> float:
    """Height that this share of the points (N, 3 or more) within reach of the middle of box (7,)
    is below, along both axes, metres; NaN where there are not 5 points."""
    heights, count = np.empty(len(points), points.dtype), 0
    for i in range(len(points)):
        if abs(points[i, 0] - box[0]) <= reach and abs(points[i, 1] - box[1]) <= reach:
            heights[count] = points[i, 2]
            count += 1
    if count < 5:
        return np.nan
    return np.sort(heights[:count])[int(share * count)]
