"""Serialization of ROS messages to CDR without ROS, with the message classes of rosbags."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from lidar_perception.types import InputError

# Types that rosbags lacks: Jazzy's vision_msgs, and clouds of other packages.
LIVOX_PACKAGES = ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
LIVOX = {
    "CustomPoint": "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line",
    "CustomMsg": "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\n"
    "uint8[3] rsvd\nCustomPoint[] points",
}
MORE_TYPES = {
    **{f"{package}/msg/{name}": text for package in LIVOX_PACKAGES for name, text in LIVOX.items()},
    "point_cloud_interfaces/msg/CompressedPointCloud2": "std_msgs/Header header\nuint32 height\n"
    "uint32 width\nsensor_msgs/PointField[] fields\n"
    "bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] compressed_data\n"
    "bool is_dense\nstring format",
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score",
    "vision_msgs/msg/ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\n"
    "geometry_msgs/PoseWithCovariance pose",
    "vision_msgs/msg/Detection3D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox3D bbox\nstring id",
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections",
}


@functools.cache
def load_typestore() -> Typestore:
    """Return the rosbags typestore of ROS 2 Jazzy with MORE_TYPES added."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in MORE_TYPES.items():
        store.register(get_types_from_msg(text, name))
    return store


def make_bag_message(type_name: str, /, **fields: Any) -> Any:
    """Make a message of a rosbags class; fields that are not given are zero, empty or False."""
    names = {}
    for name, field_type in load_typestore().fielddefs[type_name][1]:
        names[name] = fields.pop(name) if name in fields else _make_zero(field_type)
    if fields:
        raise TypeError(f"{type_name} has no field {next(iter(fields))!r}")
    return load_typestore().types[type_name](**names)


def encode(message: Any) -> bytes:
    """Serialize a message of a rosbags class to CDR."""
    return bytes(load_typestore().serialize_cdr(message, message.__msgtype__))


def decode(data: bytes, type_name: str) -> Any:
    """Deserialize CDR to a message of a rosbags class.

    Arrays in the message are views of `data`.

    Raises:
        InputError: The data are damaged.
    """
    try:
        return load_typestore().deserialize_cdr(data, type_name)
    except Exception as error:  # rosbags does not catch the errors of struct and numpy
        raise InputError(f"{len(data)} bytes are not a valid {type_name} ({error})") from None


def warm_up_type(type_name: str) -> None:
    """Let rosbags generate its code for a type, if it knows the type, before the first message."""
    if type_name in load_typestore().fielddefs:
        decode(encode(make_bag_message(type_name)), type_name)


def _make_zero(field_type: tuple[Any, Any]) -> Any:
    node, detail = field_type
    if node == Nodetype.BASE:
        name = detail[0]
        return {"string": "", "bool": False}.get(name, 0.0 if name.startswith("float") else 0)
    if node == Nodetype.NAME:
        return make_bag_message(detail)
    element, count = detail
    count = count if node == Nodetype.ARRAY else 0
    if element[0] == Nodetype.BASE and element[1][0] != "string":
        return np.zeros(count, element[1][0].replace("octet", "uint8"))
    return [_make_zero(element) for _ in range(count)]
