"""Expert knowledge as network input (paper B, Section 3): ground, clusters and a cluster map.

The experts process only the points in the network's range. Ground and clusters from earlier
stages, such as the nodes ground_segmentation and clustering, are used unchanged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from lidar_perception.classes import TABLE
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.clustering.params import ClusteringParams
from lidar_perception.clustering.shapes import classify_by_diagonal, fit_boxes, fit_ellipses
from lidar_perception.detectors.normalized_view import segment_view_ground
from lidar_perception.detectors.pointpillars.config import NetworkConfig
from lidar_perception.detectors.pointpillars.params import EXPERT_CLUSTERING, EXPERT_GROUND
from lidar_perception.ground.params import GroundParams
from lidar_perception.groups import renumber_ids
from lidar_perception.types import PointCloud

MAP_KINDS = ("vehicle", "cyclist", "pedestrian")  # channels of the cluster map, the same for all networks
# Index into MAP_KINDS by class id; the last entry, -1, is for clusters without a class.
CHANNELS = np.array([*(MAP_KINDS.index(row.motion_model) for row in TABLE), -1])


@dataclass(frozen=True)
class NetworkInput:
    """Input arrays of a network.

    Attributes:
        points: (N, 4 or 5) float32 [x y z intensity (cluster id)] in a NormalizedView, metres.
        cluster_map: (3, H, W) uint8; None if the network has no branch for it.
    """

    points: np.ndarray
    cluster_map: np.ndarray | None = None


def make_network_input(
    view: PointCloud,
    config: NetworkConfig,
    ground: np.ndarray | None = None,
    cluster_ids: np.ndarray | None = None,
    ground_params: GroundParams = EXPERT_GROUND,
    clustering: ClusteringParams = EXPERT_CLUSTERING,
) -> NetworkInput:
    """Make the input arrays of a version from the N points of a NormalizedView.

    Args:
        ground: (N,) bool; None: computed if the version needs it.
        cluster_ids: (N,) int, 0 for no cluster; None: computed if the version needs it. They are
            renumbered from 1 in the same order.
    """
    ground, cluster_ids = run_experts(view, config, ground, cluster_ids, ground_params, clustering)
    if config.remove_ground:
        obstacles = np.flatnonzero(~np.asarray(ground, bool))
        view = view.take(obstacles)
        cluster_ids = None if cluster_ids is None else cluster_ids.take(obstacles)
    points = np.zeros((len(view), config.point_columns), np.float32)
    points[:, :3] = view.xyz
    if view.intensity is not None:
        points[:, 3] = view.intensity
    if cluster_ids is None:
        return NetworkInput(points)
    cluster_ids, _ = renumber_ids(cluster_ids)
    if config.cluster_ids:
        points[:, 4] = cluster_ids
    return NetworkInput(points, draw_clusters(view.xyz, cluster_ids, config) if config.pseudo_map else None)


def run_experts(
    view: PointCloud,
    config: NetworkConfig,
    ground: np.ndarray | None = None,
    cluster_ids: np.ndarray | None = None,
    ground_params: GroundParams = EXPERT_GROUND,
    clustering: ClusteringParams = EXPERT_CLUSTERING,
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return ground (N,) bool and cluster ids (N,) int of the N points of a NormalizedView.

    They are computed if they are None and the version needs them. The cluster ids are None if the
    version does not use clusters.
    """
    uses_clusters = config.cluster_ids or config.pseudo_map
    if not uses_clusters:
        cluster_ids = None
    is_missing = uses_clusters and cluster_ids is None
    if ground is None and (config.remove_ground or is_missing):
        ground = segment_view_ground(view, ground_params)
    if is_missing:
        assert ground is not None
        cluster_ids = cluster_obstacles(view.xyz, ground, clustering)
    return ground, cluster_ids


def draw_clusters(xyz: np.ndarray, cluster_ids: np.ndarray, config: NetworkConfig) -> np.ndarray:
    """Draw the 2D pseudo-map of clusters (paper B, Section 3.1.2).

    Clusters are classified by the diagonal of their minimum-area rectangle and drawn as filled
    ellipses into the channel of their kind. An ellipse covers the cells whose centres are inside
    it, and the cell that contains its own centre.

    Args:
        xyz: (N, 3) points with cluster ids (N,), 1..K.

    Returns:
        (3, H, W) uint8, 0 or 1, channels as in MAP_KINDS, rows along y.
    """
    channels = CHANNELS[classify_by_diagonal(fit_boxes(xyz, cluster_ids, "min_area"))]
    image = np.zeros((len(MAP_KINDS), *config.grid), np.uint8)
    _fill_ellipses(image, fit_ellipses(xyz, cluster_ids), channels, config.low[0], config.low[1], config.cell)
    return image


@njit(cache=True, nogil=True)
def _fill_ellipses(image, ellipses, channels, low_x, low_y, cell_size):
    _, height, width = image.shape
    for k in range(len(ellipses)):
        if channels[k] < 0:
            continue
        x, y, a, b, yaw = ellipses[k]
        channel = image[channels[k]]
        row, column = int(np.floor((y - low_y) / cell_size)), int(np.floor((x - low_x) / cell_size))
        if 0 <= row < height and 0 <= column < width:
            channel[row, column] = 1
        if b <= 0.0:
            continue
        cos, sin = np.cos(yaw), np.sin(yaw)
        extent_x, extent_y = np.hypot(a * cos, b * sin), np.hypot(a * sin, b * cos)
        first_row = max(int(np.floor((y - extent_y - low_y) / cell_size)), 0)
        last_row = min(int(np.floor((y + extent_y - low_y) / cell_size)), height - 1)
        first_column = max(int(np.floor((x - extent_x - low_x) / cell_size)), 0)
        last_column = min(int(np.floor((x + extent_x - low_x) / cell_size)), width - 1)
        for i in range(first_row, last_row + 1):
            dy = low_y + (i + 0.5) * cell_size - y
            for j in range(first_column, last_column + 1):
                dx = low_x + (j + 0.5) * cell_size - x
                u, v = (cos * dx + sin * dy) / a, (cos * dy - sin * dx) / b
                if u * u + v * v <= 1.0:
                    channel[i, j] = 1
