"""What stands on the ground: how high points are above it, and which of them are obstacles."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from lidar_perception.ground.params import ObstacleParams, SensorPoseParams
from lidar_perception.ground.segment import level

CELL = 0.5  # m; the ground's height is the mean over the points of a cell this wide


def obstacles(xyz: np.ndarray, ground: np.ndarray, params: ObstacleParams = ObstacleParams(),
              pose: SensorPoseParams = SensorPoseParams()) -> np.ndarray:
    """(N,) bool: which of the points (N, 3), finite, are no ground (N,) and within the height band
    of params above the ground around them. pose levels the points for this. Where there is no
    ground at all, heights are unknown and every point is an obstacle."""
    chosen = ~ground
    if not (params.min_height or params.max_height) or not ground.any():
        return chosen
    xyz = level(xyz, pose)
    height = height_above(xyz.compress(chosen, axis=0), xyz.compress(ground, axis=0))
    chosen[chosen] = ((height >= (params.min_height or -np.inf))
                      & (height <= (params.max_height or np.inf)))
    return chosen


def height_above(xyz: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """(N,) float64 metres of points (N, 3) above points of the ground (M, 3), M > 0, all finite, z
    up: above the mean height of those in the CELL m wide cell around it, or in the nearest cell,
    by its centre, that has some."""
    cells = np.floor(ground[:, :2].astype(np.float64) / CELL)
    _, first, cell, count = np.unique(cells[:, 0] * 2.0**26 + cells[:, 1], return_index=True,
                                      return_inverse=True, return_counts=True)
    mean = np.bincount(cell, ground[:, 2].astype(np.float64)) / count
    return xyz[:, 2] - mean[cKDTree((cells[first] + 0.5) * CELL).query(xyz[:, :2])[1]]
