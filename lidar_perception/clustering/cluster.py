"""Points to clusters, by either of the two methods."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from lidar_perception.clustering.dbscan import distance_aware_dbscan
from lidar_perception.clustering.density import density, followed, radii
from lidar_perception.clustering.euclidean import euclidean
from lidar_perception.clustering.params import ClusteringParams
from lidar_perception.types import LidarFrame, as_frame, check_columns, usable_returns


def cluster(cloud: LidarFrame | ArrayLike, params: ClusteringParams = ClusteringParams(),
            seen: float = 0.0) -> np.ndarray:
    """Return (N,) int32 cluster ids of the N points of a LidarFrame or of an array (N, 3) or (N, 4)
    as LidarFrame.of takes it: 0 = none, 1..K. Points that are not finite, and the origin, have 0;
    no points give (0,). seen: points a square degree of view, which params.density compares with;
    0: params hold as they are. InputError for other arrays."""
    xyz = as_frame(cloud).xyz
    usable = usable_returns(xyz)
    if usable.all():
        return _clustered(xyz, params, seen)
    labels = np.zeros(len(xyz), np.int32)
    labels[usable] = _clustered(xyz[usable], params, seen)
    return labels


def _clustered(xyz: np.ndarray, given: ClusteringParams, seen: float) -> np.ndarray:
    params = followed(given, seen)
    if params.method == "dbscan":
        return distance_aware_dbscan(xyz, params.dbscan)
    reach = None if params is given else radii(xyz, seen, given.euclidean.radius,
                                               params.euclidean.radius)
    return euclidean(xyz, params.euclidean, radii=reach)


def cluster_obstacles(cloud: LidarFrame | ArrayLike, ground: np.ndarray,
                      params: ClusteringParams = ClusteringParams(),
                      sensed: np.ndarray | None = None) -> np.ndarray:
    """Return (M,) int32 cluster ids of the M points of a cloud, see cluster(), that are not ground
    (M,) bool; ground has 0. Where params are made for some density, that of all points is measured,
    or of sensed (N, 3), the cloud as the sensor sees it, where its points have been moved to
    another height. InputError for a ground of another length."""
    xyz, ground = as_frame(cloud).xyz, np.asarray(ground, bool)
    check_columns(len(xyz), ground=ground)
    labels = np.zeros(len(xyz), np.int32)
    obstacles = np.flatnonzero(~ground)
    seen = density(xyz if sensed is None else sensed) if params.density else 0.0
    labels[obstacles] = cluster(xyz.take(obstacles, axis=0), params, seen)
    return labels
