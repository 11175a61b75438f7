"""Cluster boxes: axis-aligned, snapped to the ground, filtered by height (paper A, Sections 3.3
to 3.5)."""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.params import HeightParams


@njit(cache=True)
def extents(xyz: np.ndarray, labels: np.ndarray, count: int):
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


def cluster_boxes(xyz: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """(K, 7) float32 axis-aligned boxes [x y z l w h 0] of clusters 1..K = labels.max()."""
    low, high, _ = extents(xyz, labels, int(labels.max(initial=0)))
    boxes = np.zeros((len(low), 7), np.float32)
    boxes[:, :3] = (low + high) / 2
    boxes[:, 3:6] = high - low
    return boxes


def snap_to_ground(boxes: np.ndarray, plane: np.ndarray | None) -> np.ndarray:
    """Boxes (K, 7) with the bottom face moved down to the plane under the box centre; a box that
    already reaches below it stays. Without a plane nothing moves. Paper A, Section 3.4."""
    snapped = boxes.copy()
    if plane is None:
        return snapped
    ground = boxes[:, :2].astype(np.float64) @ plane[:2] + plane[2]
    top = boxes[:, 2] + boxes[:, 5] / 2
    bottom = np.minimum(boxes[:, 2] - boxes[:, 5] / 2, ground)
    snapped[:, 2] = (top + bottom) / 2
    snapped[:, 5] = top - bottom
    return snapped


def height_matches(boxes: np.ndarray, seed_height: float, params: HeightParams) -> np.ndarray:
    """(K,) bool: |h - h_seed| <= tolerance. Paper A, Section 3.5."""
    return np.abs(boxes[:, 5] - seed_height) <= params.tolerance
