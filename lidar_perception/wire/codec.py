"""Messages to CDR bytes and back, without ROS: the classes of rosbags, for nodes and bags alike."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from lidar_perception.types import InputError

# Jazzy's vision_msgs, which rosbags does not come with.
VISION_MSGS = {
    "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "ObjectHypothesis": "string class_id\nfloat64 score",
    "ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\n"
                                "geometry_msgs/PoseWithCovariance pose",
    "Detection3D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
                   "vision_msgs/BoundingBox3D bbox\nstring id",
    "Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections",
}


@functools.cache
def typestore() -> Typestore:
    """ROS 2 Jazzy's message types, as rosbags knows them, and vision_msgs' boxes in space."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in VISION_MSGS.items():
        store.register(get_types_from_msg(text, f"vision_msgs/msg/{name}"))
    return store


def bag_message(type_name: str, /, **fields: Any) -> Any:
    """A message of rosbags' own class; fields that are not given are zero, empty or False."""
    names = {}
    for name, kind in typestore().fielddefs[type_name][1]:
        names[name] = fields.pop(name) if name in fields else _zero(kind)
    if fields:
        raise TypeError(f"{type_name} has no field {next(iter(fields))!r}")
    return typestore().types[type_name](**names)


def encode(message: Any) -> bytes:
    """CDR of a message of rosbags' class."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


def decode(data: bytes, type_name: str) -> Any:
    """Message of rosbags' class from CDR; arrays are views of data. InputError if it is broken."""
    try:
        return typestore().deserialize_cdr(data, type_name)
    except Exception as error:  # rosbags raises whatever struct, numpy or its own code raise
        raise InputError(f"{len(data)} bytes are no {type_name} ({error})") from None


def _zero(kind: tuple[Any, Any]) -> Any:
    node, detail = kind
    if node == Nodetype.BASE:
        name = detail[0]
        return {"string": "", "bool": False}.get(name, 0.0 if name.startswith("float") else 0)
    if node == Nodetype.NAME:
        return bag_message(detail)
    element, count = detail
    count = count if node == Nodetype.ARRAY else 0
    if element[0] == Nodetype.BASE and element[1][0] != "string":
        return np.zeros(count, element[1][0].replace("octet", "uint8"))
    return [_zero(element) for _ in range(count)]
