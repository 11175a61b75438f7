"""Clouds in other messages than PointCloud2: Livox CustomMsg and CompressedPointCloud2."""

from __future__ import annotations

import gzip
import zlib

import numpy as np
import zstandard
from samples import STAMP, make_any_header

from lidar_perception.wire.clouds import COMPRESSED
from lidar_perception.wire.codec import make_bag_message
from msg_utils.point_cloud2 import from_array

COMPRESS = {
    "zlib": zlib.compress,
    "gzip": gzip.compress,
    "zstd": zstandard.ZstdCompressor().compress,
    "draco": lambda data: b"DRACO" + data,
}


def livox_points(count: int = 5) -> dict[str, np.ndarray]:
    """Columns of a CustomMsg of `count` points, 10 microseconds apart."""
    rng = np.random.default_rng(count)
    return {
        "offset_time": np.arange(count, dtype=np.uint32) * 10_000,
        **{axis: rng.uniform(-20, 20, count).astype(np.float32) for axis in "xyz"},
        "reflectivity": np.linspace(0, 255, count).astype(np.uint8),
        "tag": np.full(count, 16, np.uint8),
        "line": np.arange(count, dtype=np.uint8) % 6,
    }


def livox_message(
    points: dict[str, np.ndarray],
    package: str = "livox_ros_driver2",
    stamp_ns: int = STAMP,
    frame_id: str = "livox_frame",
):
    """CustomMsg of rosbags' class."""
    rows = [
        make_bag_message(f"{package}/msg/CustomPoint", **dict(zip(points, map(lambda v: v.item(), row))))
        for row in zip(*points.values())
    ]
    return make_bag_message(
        f"{package}/msg/CustomMsg",
        header=make_any_header(make_bag_message, stamp_ns, frame_id),
        timebase=stamp_ns,
        point_num=len(rows),
        lidar_id=1,
        points=rows,
    )


def compressed_message(points: np.ndarray, packing: str, stamp_ns: int = STAMP):
    """CompressedPointCloud2 of rosbags' class, of a structured array; gzip is a kind of zlib."""
    cloud = from_array(points, make_any_header(make_bag_message, stamp_ns), make_bag_message)
    packed = COMPRESS[packing](cloud.data.tobytes())
    return make_bag_message(
        COMPRESSED,
        compressed_data=np.frombuffer(packed, np.uint8),
        format="zlib" if packing == "gzip" else packing,
        **{
            name: getattr(cloud, name)
            for name in ("header", "height", "width", "fields", "is_bigendian", "point_step", "row_step", "is_dense")
        },
    )
