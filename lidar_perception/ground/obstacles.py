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
        xyz: (N, 3) finite points; pose levels a copy of them.
        ground: (N,) bool.

    Returns:
        (N,) bool. Without any ground, heights are unknown and every point is an obstacle.
    """
    chosen = ~ground
    if not (params.min_height or params.max_height) or not ground.any():
        return chosen
    xyz = level_points(xyz, pose)
    height = height_above_ground(xyz.compress(chosen, axis=0), xyz.compress(ground, axis=0))
    chosen[chosen] = (height >= (params.min_height or -np.inf)) & (height <= (params.max_height or np.inf))
    return chosen


def height_above_ground(xyz: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """Return (N,) float64 height of points (N, 3) above ground points (M, 3), in metres.

    The height is above the mean of the ground points in the same cell, or in the cell with ground
    points whose centre is nearest. Points are finite with z up; M > 0.
    """
    cells = np.floor(ground[:, :2].astype(np.float64) / CELL_M)
    _, first, cell, count = np.unique(
        cells[:, 0] * 2.0**26 + cells[:, 1], return_index=True, return_inverse=True, return_counts=True
    )
    mean = np.bincount(cell, ground[:, 2].astype(np.float64)) / count
    return xyz[:, 2] - mean[cKDTree((cells[first] + 0.5) * CELL_M).query(xyz[:, :2])[1]]
