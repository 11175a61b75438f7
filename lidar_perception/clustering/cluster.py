"""Clustering of a cloud with a selectable method."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from lidar_perception.clustering.dbscan import distance_aware_dbscan
from lidar_perception.clustering.density import adapt_to_density, compute_radii, measure_density
from lidar_perception.clustering.euclidean import cluster_euclidean
from lidar_perception.clustering.params import ClusteringParams
from lidar_perception.types import PointCloud, are_usable_returns, as_point_cloud, check_columns


def cluster(
    cloud: PointCloud | ArrayLike, params: ClusteringParams = ClusteringParams(), density: float = 0.0
) -> np.ndarray:
    """Cluster the points of a cloud.

    Args:
        cloud: a PointCloud, or an array (N, 3) or (N, 4) as PointCloud.of takes it.
        density: measured density of the cloud in points per square degree of view, compared with
            params.density; 0 applies the parameters unchanged.

    Returns:
        (N,) int32 ids: 1..K for the clusters, 0 for points without a cluster, at the origin or with
        values that are not finite. An empty cloud gives (0,).

    Raises:
        InputError: the array has another shape or type.
    """
    xyz = as_point_cloud(cloud).xyz
    is_usable = are_usable_returns(xyz)
    if is_usable.all():
        return _cluster_usable(xyz, params, density)
    labels = np.zeros(len(xyz), np.int32)
    labels[is_usable] = _cluster_usable(xyz[is_usable], params, density)
    return labels


def _cluster_usable(xyz: np.ndarray, params: ClusteringParams, density: float) -> np.ndarray:
    adapted_params = adapt_to_density(params, density)
    if adapted_params.method == "dbscan":
        return distance_aware_dbscan(xyz, adapted_params.dbscan)
    radii = (
        None
        if adapted_params is params
        else compute_radii(xyz, density, params.euclidean.radius, adapted_params.euclidean.radius)
    )
    return cluster_euclidean(xyz, adapted_params.euclidean, radii=radii)


def cluster_obstacles(
    cloud: PointCloud | ArrayLike,
    ground: np.ndarray,
    params: ClusteringParams = ClusteringParams(),
    sensor_xyz: np.ndarray | None = None,
) -> np.ndarray:
    """Cluster the points of a cloud that are not ground.

    Args:
        cloud: M points, as cluster() takes them.
        ground: (M,) bool.
        sensor_xyz: (N, 3) points in sensor coordinates to measure the density from if
            params.density is set; default: the cloud itself. Needed if the cloud was shifted
            vertically.

    Returns:
        (M,) int32 ids as in cluster(); ground points have 0.

    Raises:
        InputError: ground has another length than the cloud.
    """
    xyz, ground = as_point_cloud(cloud).xyz, np.asarray(ground, bool)
    check_columns(len(xyz), ground=ground)
    labels = np.zeros(len(xyz), np.int32)
    obstacles = np.flatnonzero(~ground)
    density = measure_density(xyz if sensor_xyz is None else sensor_xyz) if params.density else 0.0
    labels[obstacles] = cluster(xyz.take(obstacles, axis=0), params, density)
    return labels
