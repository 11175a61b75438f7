"""Access to the message classes of the ROS 2 installation by name."""

from __future__ import annotations

import array
import functools
import importlib
from typing import Any

import numpy as np


@functools.cache
def load_message_class(type_name: str) -> type[Any]:
    """Load a message class by name, such as 'sensor_msgs/msg/PointCloud2'.

    Raises:
        ModuleNotFoundError: The message package is not installed.
    """
    package, folder, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.{folder}"), name)


def make_ros_message(type_name: str, /, **fields: Any) -> Any:
    """Make a message of an rclpy class.

    NumPy arrays are converted to array.array, because the setters do not check each of its values.
    """
    for name, value in fields.items():
        if isinstance(value, np.ndarray):
            values = array.array(value.dtype.char)
            values.frombytes(np.ascontiguousarray(value).data.cast("B"))
            fields[name] = values
    return load_message_class(type_name)(**fields)
