"""Conversion between Time and Duration messages and integer nanoseconds."""

from __future__ import annotations

from typing import Any

SECOND_NS = 1_000_000_000


def to_ns(stamp: Any) -> int:
    """Convert a Time or Duration message (rclpy or rosbags) to nanoseconds."""
    return int(stamp.sec) * SECOND_NS + int(stamp.nanosec)


def make_time(ns: int, make: Any) -> Any:
    """Convert nanoseconds to a builtin_interfaces/Time."""
    return make("builtin_interfaces/msg/Time", sec=ns // SECOND_NS, nanosec=ns % SECOND_NS)


def make_duration(ns: int, make: Any) -> Any:
    """Convert nanoseconds to a builtin_interfaces/Duration."""
    return make("builtin_interfaces/msg/Duration", sec=ns // SECOND_NS, nanosec=ns % SECOND_NS)


def make_header(ns: int, frame_id: str, make: Any) -> Any:
    """Build a std_msgs/Header from a stamp in nanoseconds and a frame."""
    return make("std_msgs/msg/Header", stamp=make_time(ns, make), frame_id=frame_id)
