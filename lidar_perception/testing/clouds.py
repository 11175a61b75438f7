"""Point cloud messages for tests."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidar_perception.types import InputError
from lidar_perception.wire.codec import make_bag_message
from msg_utils.point_cloud2 import from_array
from msg_utils.stamps import make_header

FIELDS = ("x", "y", "z", "intensity")


def make_cloud_message(points: Any, stamp_ns: int = 1, frame_id: str = "lidar", **columns: np.ndarray) -> Any:
    """Make a PointCloud2.

    Args:
        points: (N, 3) [x y z] in metres, or (N, 4) with intensity; written as float32.
        columns: Additional fields (N, ...) such as ground or ring, written with their own dtypes.

    Raises:
        InputError: `points` has a wrong shape.
    """
    points = np.asarray(points, np.float32)
    if points.ndim != 2 or points.shape[1] not in (3, 4):
        raise InputError(f"the cloud has shape {points.shape}, expected (N, 3) or (N, 4)")
    values = dict(zip(FIELDS, points.T)) | columns
    cloud = np.zeros(len(points), [(k, v.dtype, v.shape[1:]) for k, v in values.items()])
    for name, column in values.items():
        cloud[name] = column
    return from_array(cloud, make_header(stamp_ns, frame_id, make_bag_message), make_bag_message)
