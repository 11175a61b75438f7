"""Message classes by name, from the ROS 2 installation."""

from __future__ import annotations

import array
import functools
import importlib
from typing import Any

import numpy as np


@functools.cache
def message_class(type_name: str) -> type[Any]:
    """'sensor_msgs/msg/PointCloud2' -> class. ModuleNotFoundError where ROS has no such package."""
    package, kind, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


def ros_message(type_name: str, /, **fields: Any) -> Any:
    """A message of ROS's own class; NumPy arrays become array.array, which its setters take as
    they are instead of walking through them."""
    for name, value in fields.items():
        if isinstance(value, np.ndarray):
            values = array.array(value.dtype.char)
            values.frombytes(np.ascontiguousarray(value).data.cast("B"))
            fields[name] = values
    return message_class(type_name)(**fields)
