"""Clouds as messages."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidar_perception.types import InputError
from lidar_perception.wire.codec import bag_message
from msg_utils.point_cloud2 import from_array
from msg_utils.stamps import header_message

FIELDS = ("x", "y", "z", "intensity")


def cloud_message(points: Any, stamp_ns: int = 1, frame_id: str = "lidar",
                  **columns: np.ndarray) -> Any:
    """PointCloud2 of points (N, 3) [x y z] metres or (N, 4) with the intensity, as float32, and of
    other columns (N, ...) in their own types, such as ground or ring. InputError for another
    shape."""
    points = np.asarray(points, np.float32)
    if points.ndim != 2 or points.shape[1] not in (3, 4):
        raise InputError(f"a cloud of shape {points.shape}; it must be (N, 3) or (N, 4)")
    values = dict(zip(FIELDS, points.T)) | columns
    cloud = np.zeros(len(points), [(k, v.dtype, v.shape[1:]) for k, v in values.items()])
    for name, column in values.items():
        cloud[name] = column
    return from_array(cloud, header_message(stamp_ns, frame_id, bag_message), bag_message)
