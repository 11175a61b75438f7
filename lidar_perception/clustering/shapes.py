"""Boxes and ellipses of clusters, and a class by size.

Clusters are finite points (N, 3) float32 with labels (N,) int32, 0 for no cluster, 1..K; K = 0
gives no rows. Ids are contiguous by contract, but an id without points still gets a row of zeros.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.classes import BY_SIZE, CLASSES, DETECTED, MAX_DIAGONAL
from lidar_perception.clustering.params import BOX_SHAPES
from lidar_perception.clustering.rectangles import fit_rectangles, sort_by_cluster
from lidar_perception.groups import count_clusters


@njit(cache=True, nogil=True)
def find_extents(xyz: np.ndarray, labels: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return low (K, 3), high (K, 3) float32 and sizes (K,) int64 of clusters 1..K = count.

    A cluster without points has low = inf, high = -inf.
    """
    low = np.full((count, 3), np.inf, np.float32)
    high = np.full((count, 3), -np.inf, np.float32)
    sizes = np.zeros(count, np.int64)
    for i in range(len(xyz)):
        k = labels[i] - 1
        if k >= 0:
            sizes[k] += 1
            for axis in range(3):
                low[k, axis] = min(low[k, axis], xyz[i, axis])
                high[k, axis] = max(high[k, axis], xyz[i, axis])
    return low, high, sizes


def fit_boxes(xyz: np.ndarray, labels: np.ndarray, shape: str) -> np.ndarray:
    """Fit a box to each of the clusters 1..K = labels.max().

    Args:
        shape: one of BOX_SHAPES. axis_aligned: l along x, w along y, yaw 0. min_area: the exact
            rectangle of least area in x-y. l_shape: the rectangle whose sides are closest to the
            points, to one degree.

    Returns:
        (K, 7) float32 [x y z l w h yaw] in metres and radians. z and h come from the lowest and
        the highest point. min_area and l_shape have l >= w and yaw in [-pi/2, pi/2). Points at one
        place have l = w = yaw = 0; points on a line have w = 0 and yaw along it. The order of the
        points does not matter.
    """
    if shape not in BOX_SHAPES:
        raise ValueError(f"shape = {shape!r} must be one of {', '.join(BOX_SHAPES)}")
    count = count_clusters(labels)
    xyz, labels = np.ascontiguousarray(xyz, np.float32), np.ascontiguousarray(labels, np.int32)
    low, high, sizes = find_extents(xyz, labels, count)
    low[sizes == 0] = high[sizes == 0] = 0
    boxes = np.zeros((count, 7), np.float32)
    boxes[:, :3] = (low + high) / 2
    boxes[:, 3:6] = high - low
    if shape != "axis_aligned" and count:
        x, y, start = sort_by_cluster(xyz, labels, sizes)
        found = fit_rectangles(x, y, start, shape == "l_shape")
        boxes[:, [0, 1, 3, 4]] = found[:, :4]
        boxes[:, 6] = _fold_direction(found[:, 4])
    return boxes


def fit_ellipses(xyz: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Fit an ellipse in x-y to each of the clusters 1..K = labels.max().

    This is our reading of paper B's "fitted ellipse", for which it gives no formula: centre and
    axes are those of the points' covariance, and a half axis is 2 standard deviations, which is
    exact for an evenly filled ellipse. It covers most of a cluster; a few stray points may lie
    outside.

    Returns:
        (K, 5) float32 [x y a b yaw]; a >= b >= 0 are half axes in metres, yaw is the direction of
        the longer one in [-pi/2, pi/2).
    """
    members = np.flatnonzero(labels > 0)
    cluster, count = labels[members] - 1, count_clusters(labels)
    sizes = np.maximum(np.bincount(cluster, minlength=count), 1)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.bincount(cluster, values, count) / sizes

    x, y = xyz[members, :2].T.astype(np.float64)
    centre_x, centre_y = mean(x), mean(y)
    x, y = x - centre_x[cluster], y - centre_y[cluster]
    xx, yy, xy = mean(x * x), mean(y * y), mean(x * y)
    middle, root = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    a, b = 2 * np.sqrt(middle + root), 2 * np.sqrt(np.maximum(middle - root, 0))
    yaw = _fold_direction(np.arctan2(2 * xy, xx - yy) / 2)
    return np.stack([centre_x, centre_y, a, b, yaw], axis=1).astype(np.float32)


def classify_by_diagonal(boxes: np.ndarray) -> np.ndarray:
    """Classify boxes (K, 7) by their diagonal hypot(l, w) (paper B, Table 2).

    Returns:
        (K,) int32 ids into CLASSES: Pedestrian, Cyclist or Car, or -1 for a diagonal below 0.40 m
        or above 6.40 m.
    """
    sides = np.asarray(boxes, np.float32).reshape(-1, 7)[:, 3:5]
    diagonal = np.hypot(sides[:, 0], sides[:, 1])  # in float32, so that 6.40 is not above 6.40
    ids = np.full(len(diagonal), -1, np.int32)
    for name in reversed(BY_SIZE):
        ids[(diagonal >= DETECTED[name].min_diagonal) & (diagonal <= MAX_DIAGONAL)] = CLASSES.index(name)
    return ids


def _fold_direction(yaw: np.ndarray) -> np.ndarray:
    """Return the directions of lines as float32 in [-pi/2, pi/2)."""
    half = np.float32(np.pi / 2)
    folded = ((yaw + np.pi / 2) % np.pi - np.pi / 2).astype(np.float32)
    return np.where(folded >= half, -half, folded)  # values just below pi/2 round up to it
