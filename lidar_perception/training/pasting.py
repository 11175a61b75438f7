"""Compiled kernels for pasting an object into a cloud."""

from __future__ import annotations

import numpy as np
from numba import njit

MIN_RANGE_M = 1e-3  # lower limit of the range of a point
MIN_FLOOR_POINTS = 5


@njit(cache=True, nogil=True)
def find_points_in_box(points: np.ndarray, box: np.ndarray, margin: float) -> np.ndarray:
    """Return the rising indices (K,) int64 of points in a box enlarged by margin (m).

    points: (N, 3 or more); box: (7,) float64. As geometry.points_in_box, four times as fast.
    """
    found, count = np.empty(len(points), np.int64), 0
    cos, sin = np.cos(box[6]), np.sin(box[6])
    half = box[3:6] / 2 + margin
    for i in range(len(points)):
        if _is_in_box(points[i], box, half, cos, sin):
            found[count] = i
            count += 1
    return found[:count].copy()


@njit(inline="always")
def _is_in_box(point, box, half, cos, sin):
    dx, dy = point[0] - box[0], point[1] - box[1]
    return (
        abs(cos * dx + sin * dy) <= half[0]
        and abs(cos * dy - sin * dx) <= half[1]
        and abs(point[2] - box[2]) <= half[2]
    )


@njit(cache=True, nogil=True)
def paste_object(points: np.ndarray, own: np.ndarray, box: np.ndarray, margin: float, max_hidden: float) -> np.ndarray:
    """Add the points of an object to a scene, and drop the points that it replaces or hides.

    Args:
        points: (N, 4) float32 points of the scene.
        own: (K, 4) points of the object.
        box: (7,) float64 box of the object. Scene points in it are dropped.
        margin: Metres to enlarge the box by.
        max_hidden: Largest number of scene points in front of the object.

    Returns:
        The remaining scene points followed by own; (0, 4) if the object would be hidden.
    """
    bearing = np.arctan2(box[1], box[0])
    cos, sin = np.cos(bearing), np.sin(bearing)
    least, greatest = np.full(3, np.inf), np.full(3, -np.inf)  # depth, slopes aside and upwards
    for i in range(len(own)):
        depth = max(cos * own[i, 0] + sin * own[i, 1], MIN_RANGE_M)
        for k, value in enumerate((depth, (cos * own[i, 1] - sin * own[i, 0]) / depth, own[i, 2] / depth)):
            least[k], greatest[k] = min(least[k], value), max(greatest[k], value)
    half, yaw_cos, yaw_sin = box[3:6] / 2 + margin, np.cos(box[6]), np.sin(box[6])
    out = np.empty((len(points) + len(own), 4), np.float32)
    count, in_front = 0, 0
    for i in range(len(points)):
        depth = cos * points[i, 0] + sin * points[i, 1]
        if depth > 0 and not least[0] <= depth <= greatest[0]:
            aside = cos * points[i, 1] - sin * points[i, 0]
            if (
                least[1] * depth <= aside <= greatest[1] * depth
                and least[2] * depth <= points[i, 2] <= greatest[2] * depth
            ):
                if depth > greatest[0]:
                    continue
                in_front += 1
        if not _is_in_box(points[i], box, half, yaw_cos, yaw_sin):
            for k in range(4):
                out[count, k] = points[i, k]
            count += 1
    if in_front > max_hidden:
        return out[:0]
    out[count : count + len(own)] = own
    return out[: count + len(own)]


@njit(cache=True, nogil=True)
def estimate_floor(points: np.ndarray, box: np.ndarray, reach: float, share: float) -> float:
    """Return the height of the ground at a box (7,) in metres.

    It is the quantile `share` of the heights of the points (N, 3 or more) within `reach` metres of
    the box's centre along both axes; NaN with fewer than MIN_FLOOR_POINTS points.
    """
    heights, count = np.empty(len(points), points.dtype), 0
    for i in range(len(points)):
        if abs(points[i, 0] - box[0]) <= reach and abs(points[i, 1] - box[1]) <= reach:
            heights[count] = points[i, 2]
            count += 1
    if count < MIN_FLOOR_POINTS:
        return np.nan
    return np.sort(heights[:count])[int(share * count)]
