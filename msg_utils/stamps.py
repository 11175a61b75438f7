"""Conversion between Time and Duration messages and integer nanoseconds."""

from __future__ import annotations

from typing import Any

SECOND_NS = 1_000_000_000


def to_ns(stamp: Any) -> int:
    """Return the nanoseconds of a builtin_interfaces Time or Duration of rosbags or ROS."""
    return int(stamp.sec) * SECOND_NS + int(stamp.nanosec)


def make_time(ns: int, make: Any) -> Any:
    """Build a builtin_interfaces/Time of nanoseconds."""
    return make("builtin_interfaces/msg/Time", sec=ns // SECOND_NS, nanosec=ns % SECOND_NS)


def make_duration(ns: int, make: Any) -> Any:
    """Build a builtin_interfaces/Duration of nanoseconds."""
    return make("builtin_interfaces/msg/Duration", sec=ns // SECOND_NS, nanosec=ns % SECOND_NS)


def make_header(ns: int, frame_id: str, make: Any) -> Any:
    """Build a std_msgs/Header with a stamp in nanoseconds."""
    return make("std_msgs/msg/Header", stamp=make_time(ns, make), frame_id=frame_id)
