"""The crop before everything: the robot's own body, what is too near or too far, sectors."""

from __future__ import annotations

import numpy as np

from lidar_perception.robot.params import CropParams
from lidar_perception.robot.poses import moved_points
from lidar_perception.types import LidarFrame


def kept_points(xyz: np.ndarray, params: CropParams, base: np.ndarray | None = None,
                level: np.ndarray | None = None) -> np.ndarray:
    """(N,) bool: the points (N, 3) of the sensor's frame that are not left out. base (4, 4): the
    sensor's pose in the frame of params.body; level (4, 4): takes its points to the same place with
    z up and x ahead, where params.sectors are. None: that is the sensor's own frame.

    A point on a limit of range or body is kept, one on the edge of a sector is left out. Points
    that are not finite count as far away.
    """
    kept = np.ones(len(xyz), bool)
    with np.errstate(invalid="ignore", over="ignore"):
        if params.min_range or params.max_range:
            square = np.einsum("ij,ij->i", xyz, xyz)
            kept &= ~(square < np.float32(params.min_range) ** 2)
            if params.max_range:
                kept &= square <= np.float32(params.max_range) ** 2
        if params.body:
            at = xyz if base is None else moved_points(xyz, base)
            low, high = np.reshape(params.body, (2, 3)).astype(xyz.dtype)
            kept &= ~((at > low) & (at < high)).all(axis=1)
        if params.sectors:
            x, y = (xyz if level is None else xyz @ level[:2, :3].T.astype(xyz.dtype)).T[:2]
            azimuth = np.degrees(np.arctan2(y, x))
            for start, end in np.reshape(params.sectors, (-1, 2)):
                whole = end - start >= 360
                kept &= ~(whole | ((azimuth - start) % 360 <= (end - start) % 360))
    return kept


def cropped(frame: LidarFrame, params: CropParams, base: np.ndarray | None = None,
            level: np.ndarray | None = None) -> tuple[np.ndarray, LidarFrame]:
    """indices (M,) int64 of the points of the frame that are kept, see kept_points, and the frame
    of these; the frame itself where nothing is to be left out."""
    if not params.enabled:
        return np.arange(len(frame)), frame
    indices = np.flatnonzero(kept_points(frame.xyz, params, base, level))
    return indices, frame.take(indices)
