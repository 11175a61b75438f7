"""Reading of point cloud messages: PointCloud2, CompressedPointCloud2 and Livox CustomMsg."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lidar_perception.types import InputError
from lidar_perception.wire.codec import LIVOX_PACKAGES, decode, make_bag_message
from lidar_perception.wire.compression import decompress
from lidar_perception.wire.livox import decode_livox

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
COMPRESSED = "point_cloud_interfaces/msg/CompressedPointCloud2"
LIVOX = tuple(f"{package}/msg/CustomMsg" for package in LIVOX_PACKAGES)
CLOUD_TYPES = (POINT_CLOUD, COMPRESSED, *LIVOX)
COMPRESSIONS = ("zlib", "zstd")

# Package of packet messages -> driver that converts the packets to clouds.
DRIVER_BY_PACKAGE = {
    "velodyne_msgs": "velodyne_pointcloud (velodyne_transform_node)",
    "ouster_msgs": "ouster_ros (replay.launch.xml)",
    "ouster_ros": "ouster_ros (replay.launch.xml)",
    "ouster_sensor_msgs": "ouster_ros (replay.launch.xml)",
    "hesai_ros_driver": "hesai_ros_driver (source_type 3)",
    "hesai_lidar": "HesaiLidar_General_ROS",
    "pandar_msgs": "nebula_ros",
    "nebula_msgs": "nebula_ros",
    "rslidar_msg": "rslidar_sdk (msg_source 2)",
    "rslidar_msgs": "rslidar_sdk (msg_source 2)",
    "lslidar_msgs": "lslidar_driver",
    "seyond": "seyond_ros_driver",
    "innovusion": "seyond_ros_driver",
}


def decode_cloud(data: bytes, type_name: str) -> Any:
    """Decode a cloud message in CDR, of one of CLOUD_TYPES, to a PointCloud2 (class of rosbags).

    Raises:
        InputError: The message is damaged, or its compression is not supported.
    """
    if type_name in LIVOX:
        return decode_livox(data)
    msg = decode(data, type_name)
    return _decompress(msg) if type_name == COMPRESSED else msg


def check_readable(data: bytes, type_name: str) -> None:
    """Check that the compression of a cloud message is supported.

    Damaged messages are accepted here; decode_cloud reports them.

    Raises:
        InputError: The compression is not supported.
    """
    if type_name == COMPRESSED:
        try:
            msg = decode(data, type_name)
        except InputError:
            return
        _check_compression(msg)


def find_cloud_topics(topics: Mapping[str, str]) -> list[str]:
    """Return the sorted names of the cloud topics, without compressed copies such as /points/zlib.

    Args:
        topics: Message type of each topic.
    """
    clouds = {topic for topic, type_name in topics.items() if type_name in CLOUD_TYPES}
    return sorted(topic for topic in clouds if topics[topic] != COMPRESSED or topic.rpartition("/")[0] not in clouds)


def diagnose_packets(topics: Mapping[str, str]) -> str | None:
    """Return an error message for a topic with raw sensor packets or an unsupported scan type.

    The message includes the remedy. Returns None if there is no such topic.

    Args:
        topics: Message type of each topic.
    """
    for topic, type_name in sorted(topics.items()):
        package, _, name = type_name.replace("/msg/", "/").partition("/")
        if driver := DRIVER_BY_PACKAGE.get(package):
            return (
                f"{type_name} on {topic} contains raw sensor packets, which cannot be read: "
                f"play the bag to {driver} and record the clouds that it publishes"
            )
        if package == "sensor_msgs" and name in ("PointCloud", "LaserScan"):
            return (
                f"{type_name} on {topic} cannot be read: record its scans as PointCloud2, with "
                f"{'laser_geometry' if name == 'LaserScan' else 'point_cloud_converter'}"
            )
    return None


def _check_compression(msg: Any) -> str:
    name: str = msg.format.strip().lower()
    if name not in COMPRESSIONS:
        raise InputError(
            f"cloud compression '{name}' is not supported, only "
            f"{' and '.join(COMPRESSIONS)}: play the bag to 'ros2 run "
            "point_cloud_transport republish --ros-args -p in_transport:="
            f"{name or 'NAME'} -p out_transport:=raw' and record its output"
        )
    return name


def _decompress(msg: Any) -> Any:
    compression = _check_compression(msg)
    try:
        data = decompress(msg.compressed_data.tobytes(), compression, None)
    except Exception as error:  # zlib and zstandard raise their own types
        raise InputError(f"a {compression}-compressed cloud is damaged ({error})") from None
    return make_bag_message(
        POINT_CLOUD,
        data=np.frombuffer(data, np.uint8),
        **{
            name: getattr(msg, name)
            for name in ("header", "height", "width", "fields", "is_bigendian", "point_step", "row_step", "is_dense")
        },
    )
