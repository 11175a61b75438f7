"""Crop of a cloud: the robot's own body, points that are too near or too far, and sectors."""

from __future__ import annotations

import numpy as np

from lidar_perception.robot.params import CropParams
from lidar_perception.robot.poses import transform_points
from lidar_perception.types import PointCloud


def select_points(
    xyz: np.ndarray, params: CropParams, base: np.ndarray | None = None, level: np.ndarray | None = None
) -> np.ndarray:
    """Select the points (N, 3) in the sensor's frame that the crop keeps.

    A point on a limit of range or body is kept; a point on the edge of a sector is removed. Points
    that are not finite count as infinitely far away.

    Args:
        base: (4, 4) pose of the sensor in the frame of params.body; None for the sensor's frame.
        level: (4, 4) transform of points to the level frame of params.sectors, with z up and x
            ahead; None for the sensor's frame.

    Returns:
        (N,) bool.
    """
    kept = np.ones(len(xyz), bool)
    with np.errstate(invalid="ignore", over="ignore"):
        if params.min_range or params.max_range:
            square = np.einsum("ij,ij->i", xyz, xyz)
            kept &= ~(square < np.float32(params.min_range) ** 2)
            if params.max_range:
                kept &= square <= np.float32(params.max_range) ** 2
        if params.body:
            at = xyz if base is None else transform_points(xyz, base)
            low, high = np.reshape(params.body, (2, 3)).astype(xyz.dtype)
            kept &= ~((at > low) & (at < high)).all(axis=1)
        if params.sectors:
            x, y = (xyz if level is None else xyz @ level[:2, :3].T.astype(xyz.dtype)).T[:2]
            azimuth = np.degrees(np.arctan2(y, x))
            for start, end in np.reshape(params.sectors, (-1, 2)):
                whole = end - start >= 360
                kept &= ~(whole | ((azimuth - start) % 360 <= (end - start) % 360))
    return kept


def crop_frame(
    frame: PointCloud, params: CropParams, base: np.ndarray | None = None, level: np.ndarray | None = None
) -> tuple[np.ndarray, PointCloud]:
    """Crop a frame; base and level are those of select_points.

    Returns:
        indices (M,) int64 of the points kept, and the frame of these points; the frame itself if
        params removes nothing.
    """
    if not params.enabled:
        return np.arange(len(frame)), frame
    indices = np.flatnonzero(select_points(frame.xyz, params, base, level))
    return indices, frame.take(indices)
