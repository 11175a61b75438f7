"""Exact DBSCAN on a grid, and the distance-aware DBSCAN of paper A."""

from __future__ import annotations

import numpy as np

from lidar_perception.clustering.dense import dbscan_by_cells
from lidar_perception.clustering.sparse import dbscan_by_pairs
from lidar_perception.geometry import horizontal_range
from lidar_perception.params import DbscanParams


def distance_aware_dbscan(xyz: np.ndarray, params: DbscanParams = DbscanParams()) -> np.ndarray:
    """(N,) int32 cluster ids of points (N, 3) float32 in the LiDAR frame; 0 is noise.

    Each band of horizontal range [range_limits[i-1], range_limits[i]) is clustered by itself with
    eps[i]; ids go on from band to band (paper A, Section 3.3).
    """
    band = np.searchsorted(np.asarray(params.range_limits), horizontal_range(xyz), side="right")
    labels = np.zeros(len(xyz), np.int32)
    last = 0
    for i, eps in enumerate(params.eps):
        members = np.flatnonzero(band == i)
        if len(members) < params.min_samples:
            continue
        found = dbscan(xyz.take(members, axis=0), eps, params.min_samples)
        labels[members] = np.where(found > 0, found + last, 0)
        last += int(found.max(initial=0))
    return labels


def dbscan(xyz: np.ndarray, eps: float, min_samples: int) -> np.ndarray:
    """(N,) int32 labels of finite points (N, 3): 0 noise, clusters 1..K.

    The labels are those of scikit-learn's DBSCAN plus one, border points included: clusters are
    numbered by their first core point, and a border point between clusters goes to the first.
    """
    if len(xyz) == 0:
        return np.zeros(0, np.int32)
    xyz = np.ascontiguousarray(xyz, np.float32)
    labels = dbscan_by_pairs(xyz, eps, min_samples)
    return dbscan_by_cells(xyz, eps, min_samples) if labels is None else labels
