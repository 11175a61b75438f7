"""Time and Duration messages <-> int nanoseconds."""

from __future__ import annotations

from typing import Any

SECOND = 1_000_000_000


def to_ns(stamp: Any) -> int:
    """Nanoseconds of a builtin_interfaces Time or Duration (rosbags' or ROS's own class)."""
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


def time_message(ns: int, make: Any) -> Any:
    """builtin_interfaces/Time of nanoseconds."""
    return make("builtin_interfaces/msg/Time", sec=ns // SECOND, nanosec=ns % SECOND)


def duration_message(ns: int, make: Any) -> Any:
    """builtin_interfaces/Duration of nanoseconds."""
    return make("builtin_interfaces/msg/Duration", sec=ns // SECOND, nanosec=ns % SECOND)


def header_message(ns: int, frame_id: str, make: Any) -> Any:
    """std_msgs/Header with the stamp of nanoseconds."""
    return make("std_msgs/msg/Header", stamp=time_message(ns, make), frame_id=frame_id)
