"""Compiled kernels for pasting an object into a cloud."""

from __future__ import annotations

import numpy as np
from numba import njit

MIN_RANGE_M = 1e-3  # smaller ranges are raised to this, to avoid division by 0
MIN_FLOOR_POINTS = 5


@njit(cache=True, nogil=True)
def find_points_in_box(points: np.ndarray, box: np.ndarray, margin: float) -> np.ndarray:
    """Return the ascending indices (K,) int64 of the points in a box that is enlarged by `margin` metres.

    Gives the same points as geometry.points_in_box, but is four times as fast.

    Args:
        points: (N, 3 or more).
        box: (7,) float64.
    """
    indices, count = np.empty(len(points), np.int64), 0
    cos, sin = np.cos(box[6]), np.sin(box[6])
    half_size = box[3:6] / 2 + margin
    for i in range(len(points)):
        if _is_in_box(points[i], box, half_size, cos, sin):
            indices[count] = i
            count += 1
    return indices[:count].copy()


@njit(inline="always")
def _is_in_box(point, box, half_size, cos, sin):
    dx, dy = point[0] - box[0], point[1] - box[1]
    return (
        abs(cos * dx + sin * dy) <= half_size[0]
        and abs(cos * dy - sin * dx) <= half_size[1]
        and abs(point[2] - box[2]) <= half_size[2]
    )


@njit(cache=True, nogil=True)
def paste_object(
    points: np.ndarray, object_points: np.ndarray, box: np.ndarray, margin: float, max_hidden: float
) -> np.ndarray:
    """Add the points of an object to a scene, and drop the points that it replaces or hides.

    Args:
        points: (N, 4) float32 points of the scene.
        object_points: (K, 4) points of the object.
        box: (7,) float64 box of the object. Scene points in it are dropped.
        margin: Margin of the box in metres.
        max_hidden: Maximum allowed number of scene points in front of the object.

    Returns:
        The remaining scene points followed by object_points; (0, 4) if the object would be hidden.
    """
    bearing = np.arctan2(box[1], box[0])
    cos, sin = np.cos(bearing), np.sin(bearing)
    # Limits of the object's depth, horizontal slope and vertical slope.
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for i in range(len(object_points)):
        depth = max(cos * object_points[i, 0] + sin * object_points[i, 1], MIN_RANGE_M)
        for k, value in enumerate(
            (depth, (cos * object_points[i, 1] - sin * object_points[i, 0]) / depth, object_points[i, 2] / depth)
        ):
            low[k], high[k] = min(low[k], value), max(high[k], value)
    half_size, yaw_cos, yaw_sin = box[3:6] / 2 + margin, np.cos(box[6]), np.sin(box[6])
    out = np.empty((len(points) + len(object_points), 4), np.float32)
    count, in_front = 0, 0
    for i in range(len(points)):
        depth = cos * points[i, 0] + sin * points[i, 1]
        if depth > 0 and not low[0] <= depth <= high[0]:
            lateral = cos * points[i, 1] - sin * points[i, 0]
            if low[1] * depth <= lateral <= high[1] * depth and low[2] * depth <= points[i, 2] <= high[2] * depth:
                if depth > high[0]:
                    continue
                in_front += 1
        if not _is_in_box(points[i], box, half_size, yaw_cos, yaw_sin):
            for k in range(4):
                out[count, k] = points[i, k]
            count += 1
    if in_front > max_hidden:
        return out[:0]
    out[count : count + len(object_points)] = object_points
    return out[: count + len(object_points)]


@njit(cache=True, nogil=True)
def estimate_floor(points: np.ndarray, box: np.ndarray, half_size: float, quantile: float) -> float:
    """Estimate the height of the ground below a box (7,) in metres.

    Args:
        points: (N, 3 or more).
        box: (7,) box.
        half_size: Half the side of the square around the box's centre whose points are used, m.
        quantile: Quantile (0 .. 1) of their heights that is taken as the ground.

    Returns:
        The height, or NaN with fewer than MIN_FLOOR_POINTS points.
    """
    heights, count = np.empty(len(points), points.dtype), 0
    for i in range(len(points)):
        if abs(points[i, 0] - box[0]) <= half_size and abs(points[i, 1] - box[1]) <= half_size:
            heights[count] = points[i, 2]
            count += 1
    if count < MIN_FLOOR_POINTS:
        return np.nan
    return np.sort(heights[:count])[int(quantile * count)]
