"""Crop of a cloud by the box of the robot's body, by range and by azimuth sectors."""

from __future__ import annotations

import numpy as np

from lidar_perception.robot.params import CropParams
from lidar_perception.robot.poses import transform_points
from lidar_perception.types import PointCloud


def select_points(
    xyz: np.ndarray, params: CropParams, base: np.ndarray | None = None, level: np.ndarray | None = None
) -> np.ndarray:
    """Return a mask (N,) bool of the points that the crop keeps.

    Points exactly on a range limit or on the surface of the body are kept; points on the edge of a
    sector are removed. Points that are not finite are treated as infinitely far away.

    Args:
        xyz: (N, 3) points in the sensor's frame.
        params: Parameters of the crop.
        base: (4, 4) pose of the sensor in the frame of params.body; None for the sensor's frame.
        level: (4, 4) transform of points to the level frame of params.sectors, with z up and x
            ahead; None for the sensor's frame.
    """
    is_kept = np.ones(len(xyz), bool)
    with np.errstate(invalid="ignore", over="ignore"):
        if params.min_range or params.max_range:
            squared_range = np.einsum("ij,ij->i", xyz, xyz)
            is_kept &= ~(squared_range < np.float32(params.min_range) ** 2)
            if params.max_range:
                is_kept &= squared_range <= np.float32(params.max_range) ** 2
        if params.body:
            in_base = xyz if base is None else transform_points(xyz, base)
            low, high = np.reshape(params.body, (2, 3)).astype(xyz.dtype)
            is_kept &= ~((in_base > low) & (in_base < high)).all(axis=1)
        if params.sectors:
            x, y = (xyz if level is None else xyz @ level[:2, :3].T.astype(xyz.dtype)).T[:2]
            azimuth = np.degrees(np.arctan2(y, x))
            for start, end in np.reshape(params.sectors, (-1, 2)):
                is_full_circle = end - start >= 360
                is_kept &= ~(is_full_circle | ((azimuth - start) % 360 <= (end - start) % 360))
    return is_kept


def crop_frame(
    frame: PointCloud, params: CropParams, base: np.ndarray | None = None, level: np.ndarray | None = None
) -> tuple[np.ndarray, PointCloud]:
    """Crop a frame; for base and level see select_points.

    Returns:
        Indices (M,) int64 of the points that are kept, and the frame with these points (the same
        object if the crop is off).
    """
    if not params.enabled:
        return np.arange(len(frame)), frame
    indices = np.flatnonzero(select_points(frame.xyz, params, base, level))
    return indices, frame.take(indices)
