"""Messages that hold a cloud: PointCloud2, its compressed form, and Livox CustomMsg."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lidar_perception.types import InputError
from lidar_perception.wire.codec import LIVOX_PACKAGES, bag_message, decode
from lidar_perception.wire.livox import livox_cloud
from lidar_perception.wire.unpacking import unpack

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
COMPRESSED = "point_cloud_interfaces/msg/CompressedPointCloud2"
LIVOX = tuple(f"{package}/msg/CustomMsg" for package in LIVOX_PACKAGES)
CLOUD_TYPES = (POINT_CLOUD, COMPRESSED, *LIVOX)
COMPRESSIONS = ("zlib", "zstd")

# Package of other messages of a sensor -> what makes clouds of them.
DRIVERS = {
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


def decode_cloud(data: bytes, kind: str) -> Any:
    """Return the PointCloud2 (rosbags' class) of a message in CDR, whose type is one of
    CLOUD_TYPES. InputError where it is broken, or compressed in a way that is not read."""
    if kind in LIVOX:
        return livox_cloud(data)
    msg = decode(data, kind)
    return _unpacked(msg) if kind == COMPRESSED else msg


def check_readable(data: bytes, kind: str) -> None:
    """Raise InputError, with a remedy, for a cloud that is compressed in a way that is not read; a
    broken message passes."""
    if kind == COMPRESSED:
        try:
            msg = decode(data, kind)
        except InputError:
            return
        _compression(msg)


def cloud_topics(topics: Mapping[str, str]) -> list[str]:
    """Return the topics with clouds, of name -> type, by name. A compressed form of another one
    (/points/zlib beside /points) is left out."""
    clouds = {topic for topic, kind in topics.items() if kind in CLOUD_TYPES}
    return sorted(topic for topic in clouds
                  if topics[topic] != COMPRESSED or topic.rpartition("/")[0] not in clouds)


def packets_problem(topics: Mapping[str, str]) -> str | None:
    """Return a sentence with the remedy if one of the topics, name -> type, has the raw packets of
    a sensor; None otherwise."""
    for topic, kind in sorted(topics.items()):
        package, _, name = kind.replace("/msg/", "/").partition("/")
        if driver := DRIVERS.get(package):
            return (f"{kind} on {topic} has the raw packets of a sensor, which are not read: play "
                    f"the bag to {driver} and record the clouds that it publishes")
        if package == "sensor_msgs" and name in ("PointCloud", "LaserScan"):
            return (f"{kind} on {topic} is not read: record its scans as PointCloud2, with "
                    f"{'laser_geometry' if name == 'LaserScan' else 'point_cloud_converter'}")
    return None


def _compression(msg: Any) -> str:
    name: str = msg.format.strip().lower()
    if name not in COMPRESSIONS:
        raise InputError(f"clouds compressed by {name or 'nothing known'} are not read, only by "
                         f"{' and '.join(COMPRESSIONS)}: play the bag to 'ros2 run "
                         "point_cloud_transport republish --ros-args -p in_transport:="
                         f"{name or 'NAME'} -p out_transport:=raw' and record its output")
    return name


def _unpacked(msg: Any) -> Any:
    packing = _compression(msg)
    try:
        data = unpack(msg.compressed_data.tobytes(), packing, None)
    except Exception as error:  # zlib and zstandard raise their own
        raise InputError(f"a cloud compressed by {packing} is broken ({error})") from None
    return bag_message(POINT_CLOUD, data=np.frombuffer(data, np.uint8), **{
        name: getattr(msg, name) for name in (
            "header", "height", "width", "fields", "is_bigendian", "point_step", "row_step",
            "is_dense")})
