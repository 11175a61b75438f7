"""Points to clusters, by either of the two methods."""

from __future__ import annotations

import numpy as np

from lidar_perception.clustering.dbscan import distance_aware_dbscan
from lidar_perception.clustering.euclidean import euclidean
from lidar_perception.clustering.params import ClusteringParams
from lidar_perception.types import usable_returns

METHODS = {  # finite points (M, 3), params -> (M,) int32
    "dbscan": lambda xyz, p: distance_aware_dbscan(xyz, p.dbscan),
    "euclidean": lambda xyz, p: euclidean(xyz, p.euclidean),
}


def cluster(xyz: np.ndarray, params: ClusteringParams = ClusteringParams()) -> np.ndarray:
    """(N,) int32 cluster ids of points (N, 3) float32, metres in the LiDAR frame: 0 = none, 1..K.
    Points that are not finite, and the origin, have 0; no points give (0,)."""
    usable = usable_returns(xyz)
    if usable.all():
        return METHODS[params.method](xyz, params)
    labels = np.zeros(len(xyz), np.int32)
    labels[usable] = METHODS[params.method](xyz[usable], params)
    return labels


def cluster_obstacles(xyz: np.ndarray, ground: np.ndarray,
                      params: ClusteringParams = ClusteringParams()) -> np.ndarray:
    """(M,) int32 cluster ids of the points (M, 3) that are not ground (M,) bool; ground has 0."""
    labels = np.zeros(len(xyz), np.int32)
    obstacles = np.flatnonzero(~ground)
    labels[obstacles] = cluster(xyz.take(obstacles, axis=0), params)
    return labels
