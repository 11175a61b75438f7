"""Height of points above the ground around them, and the selection of obstacles by it."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from lidar_perception.ground.params import ObstacleParams, SensorPoseParams
from lidar_perception.ground.segment import level_points

CELL_M = 0.5  # width of the cells whose mean is the height of the ground


def find_obstacles(
    xyz: np.ndarray,
    ground: np.ndarray,
    params: ObstacleParams = ObstacleParams(),
    pose: SensorPoseParams = SensorPoseParams(),
) -> np.ndarray:
    """Select the points that are not ground and within a height band above the ground around them.

    Args:
        xyz: (N, 3) finite points.
        ground: (N,) bool.
        pose: mounting of the sensor, used to level a copy of the points.

    Returns:
        (N,) bool, True = obstacle. Without ground points, heights are unknown, so all points are
        obstacles.
    """
    is_obstacle = ~ground
    if not (params.min_height or params.max_height) or not ground.any():
        return is_obstacle
    xyz = level_points(xyz, pose)
    height = compute_height_above_ground(xyz.compress(is_obstacle, axis=0), xyz.compress(ground, axis=0))
    is_obstacle[is_obstacle] = (height >= (params.min_height or -np.inf)) & (height <= (params.max_height or np.inf))
    return is_obstacle


def compute_height_above_ground(xyz: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """Compute the height of points above the ground around them.

    The ground height is the mean of the ground points in the nearest cell that has any.

    Args:
        xyz: (N, 3) finite points, z up, in metres.
        ground: (M, 3) finite ground points, M > 0.

    Returns:
        (N,) float64 heights in metres.
    """
    cells = np.floor(ground[:, :2].astype(np.float64) / CELL_M)
    _, first, cell, count = np.unique(
        cells[:, 0] * 2.0**26 + cells[:, 1], return_index=True, return_inverse=True, return_counts=True
    )
    mean = np.bincount(cell, ground[:, 2].astype(np.float64)) / count
    return xyz[:, 2] - mean[cKDTree((cells[first] + 0.5) * CELL_M).query(xyz[:, :2])[1]]
