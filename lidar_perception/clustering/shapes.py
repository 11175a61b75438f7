"""What a cluster looks like from above: its box, its ellipse, and a class by its size.

Clusters come as finite points (N, 3) float32 and labels (N,) int32, 0 = no cluster, 1..K; K = 0
gives no rows. Ids are contiguous by contract; an id without points still gets a row of zeros.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.classes import BY_SIZE, CLASSES, DETECTED, MAX_DIAGONAL
from lidar_perception.clustering.params import BOX_SHAPES
from lidar_perception.clustering.rectangles import grouped, rectangles
from lidar_perception.groups import cluster_count


@njit(cache=True, nogil=True)
def extents(xyz: np.ndarray, labels: np.ndarray,
            count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """low (K, 3), high (K, 3) float32 of the points of clusters 1..K, and sizes (K,) int64.
    A cluster without points has low = inf, high = -inf."""
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


def oriented_boxes(xyz: np.ndarray, labels: np.ndarray, shape: str) -> np.ndarray:
    """(K, 7) float32 boxes [x y z l w h yaw] of clusters 1..K = labels.max(), metres, radians.

    shape, one of BOX_SHAPES. axis_aligned: l along x, w along y, yaw 0. min_area: the rectangle
    of least area in x-y, exactly. l_shape: the rectangle whose sides the points lie closest to,
    to one degree. The last two have l >= w and yaw in [-pi/2, pi/2); at one place l = w = yaw = 0,
    on a line w = 0 and yaw is along it. z and h come from the lowest and the highest point. The
    order of the points makes no difference.
    """
    if shape not in BOX_SHAPES:
        raise ValueError(f"shape = {shape!r} must be one of {', '.join(BOX_SHAPES)}")
    count = cluster_count(labels)
    xyz, labels = np.ascontiguousarray(xyz, np.float32), np.ascontiguousarray(labels, np.int32)
    low, high, sizes = extents(xyz, labels, count)
    low[sizes == 0] = high[sizes == 0] = 0
    boxes = np.zeros((count, 7), np.float32)
    boxes[:, :3] = (low + high) / 2
    boxes[:, 3:6] = high - low
    if shape != "axis_aligned" and count:
        x, y, start = grouped(xyz, labels, sizes)
        found = rectangles(x, y, start, shape == "l_shape")
        boxes[:, [0, 1, 3, 4]] = found[:, :4]
        boxes[:, 6] = _folded(found[:, 4])
    return boxes


def ellipses(xyz: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """(K, 5) float32 ellipses [x y a b yaw] in x-y of clusters 1..K = labels.max(); a >= b >= 0
    are half axes in metres, yaw of the long one in [-pi/2, pi/2). (0, 5) without clusters.

    Our reading of paper B's "fitted ellipse" (it gives no formula): centre and axes are those of
    the points' covariance, and a half axis is 2 standard deviations, as it is exactly for an
    ellipse filled evenly. It covers most of a cluster; a few stray points may lie outside.
    """
    members = np.flatnonzero(labels > 0)
    cluster, count = labels[members] - 1, cluster_count(labels)
    sizes = np.maximum(np.bincount(cluster, minlength=count), 1)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.bincount(cluster, values, count) / sizes

    x, y = xyz[members, :2].T.astype(np.float64)
    centre_x, centre_y = mean(x), mean(y)
    x, y = x - centre_x[cluster], y - centre_y[cluster]
    xx, yy, xy = mean(x * x), mean(y * y), mean(x * y)
    middle, root = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    a, b = 2 * np.sqrt(middle + root), 2 * np.sqrt(np.maximum(middle - root, 0))
    yaw = _folded(np.arctan2(2 * xy, xx - yy) / 2)
    return np.stack([centre_x, centre_y, a, b, yaw], axis=1).astype(np.float32)


def class_by_diagonal(boxes: np.ndarray) -> np.ndarray:
    """(K,) int32 ids into CLASSES of boxes (K, 7) by the diagonal hypot(l, w): Pedestrian,
    Cyclist, Car, or -1, none of them: below 0.40 m or above 6.40 m. Paper B, Table 2."""
    sides = np.asarray(boxes, np.float32).reshape(-1, 7)[:, 3:5]
    diagonal = np.hypot(sides[:, 0], sides[:, 1])  # float32, so that 6.40 is not above 6.40
    ids = np.full(len(diagonal), -1, np.int32)
    for name in reversed(BY_SIZE):
        ids[(diagonal >= DETECTED[name].min_diagonal) & (diagonal <= MAX_DIAGONAL)] = CLASSES.index(
            name)
    return ids


def _folded(yaw: np.ndarray) -> np.ndarray:
    """Directions of lines as float32 in [-pi/2, pi/2)."""
    half = np.float32(np.pi / 2)
    folded = ((yaw + np.pi / 2) % np.pi - np.pi / 2).astype(np.float32)
    return np.where(folded >= half, -half, folded)  # a hair below pi/2 rounds to it
