"""Box and ellipse fitting, and size-based classification of clusters.

Clusters are finite points (N, 3) float32 with labels (N,) int32: 0 for no cluster, 1..K for the
clusters. Labels should be contiguous; one without points gets a row of zeros.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.classes import CLASSES, CLASSES_BY_SIZE, DETECTED, MAX_DIAGONAL
from lidar_perception.clustering.params import BOX_SHAPES
from lidar_perception.clustering.rectangles import fit_rectangles, sort_by_cluster
from lidar_perception.groups import count_clusters


@njit(cache=True, nogil=True)
def find_extents(xyz: np.ndarray, labels: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the extents and sizes of clusters.

    Args:
        xyz: (N, 3) points in metres.
        labels: (N,) cluster ids from 1 to count; 0 for points without a cluster.
        count: number of clusters, K.

    Returns:
        low (K, 3) and high (K, 3) float32, the corners of the axis-aligned box in metres, inf and
        -inf for a cluster without points; sizes (K,) int64, the number of points.
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
    """Fit a box to each cluster.

    Args:
        shape: one of BOX_SHAPES. axis_aligned: l along x, w along y, yaw 0. min_area: the exact
            rectangle of least area in x-y. l_shape: the rectangle whose sides are closest to the
            points, to one degree.

    Returns:
        (K, 7) float32 [x y z l w h yaw] in metres and radians, K = labels.max(). z and h span the
        lowest and the highest point. min_area and l_shape have l >= w and yaw in [-pi/2, pi/2).
        Coincident points have l = w = yaw = 0; collinear points have w = 0 and yaw along the line.
        The result does not depend on the order of the points.

    Raises:
        ValueError: the shape is unknown.
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
        rectangles = fit_rectangles(x, y, start, shape == "l_shape")
        boxes[:, [0, 1, 3, 4]] = rectangles[:, :4]
        boxes[:, 6] = _fold_direction(rectangles[:, 4])
    return boxes


def fit_ellipses(xyz: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Fit an ellipse in x-y to each cluster.

    Paper B gives no formula for its "fitted ellipse". Here, the centre is the mean of the points,
    the axes are those of their covariance, and each semi-axis is 2 standard deviations, which is
    exact for a uniformly filled ellipse. A few outliers may lie outside.

    Returns:
        (K, 5) float32 [x y a b yaw], K = labels.max(): a >= b >= 0 are the semi-axes in metres, yaw
        is the direction of the longer one in [-pi/2, pi/2).
    """
    members = np.flatnonzero(labels > 0)
    cluster, count = labels[members] - 1, count_clusters(labels)
    sizes = np.maximum(np.bincount(cluster, minlength=count), 1)

    def compute_mean(values: np.ndarray) -> np.ndarray:
        return np.bincount(cluster, values, count) / sizes

    x, y = xyz[members, :2].T.astype(np.float64)
    centre_x, centre_y = compute_mean(x), compute_mean(y)
    x, y = x - centre_x[cluster], y - centre_y[cluster]
    xx, yy, xy = compute_mean(x * x), compute_mean(y * y), compute_mean(x * y)
    half_trace, half_gap = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    a, b = 2 * np.sqrt(half_trace + half_gap), 2 * np.sqrt(np.maximum(half_trace - half_gap, 0))
    yaw = _fold_direction(np.arctan2(2 * xy, xx - yy) / 2)
    return np.stack([centre_x, centre_y, a, b, yaw], axis=1).astype(np.float32)


def classify_by_diagonal(boxes: np.ndarray) -> np.ndarray:
    """Classify boxes (K, 7) by their diagonal hypot(l, w) (paper B, Table 2).

    Returns:
        (K,) int32 indices into CLASSES: Pedestrian, Cyclist or Car; -1 if the diagonal is below
        0.40 m or above 6.40 m.
    """
    sides = np.asarray(boxes, np.float32).reshape(-1, 7)[:, 3:5]
    diagonal = np.hypot(sides[:, 0], sides[:, 1])  # in float32, so that 6.40 is not above 6.40
    ids = np.full(len(diagonal), -1, np.int32)
    for name in reversed(CLASSES_BY_SIZE):
        ids[(diagonal >= DETECTED[name].min_diagonal) & (diagonal <= MAX_DIAGONAL)] = CLASSES.index(name)
    return ids


def _fold_direction(yaw: np.ndarray) -> np.ndarray:
    """Wrap the directions of lines to [-pi/2, pi/2) float32."""
    limit = np.float32(np.pi / 2)
    folded_yaw = ((yaw + np.pi / 2) % np.pi - np.pi / 2).astype(np.float32)
    return np.where(folded_yaw >= limit, -limit, folded_yaw)  # values just below pi/2 round up to it
