"""Diagnostics of a node: state, counts, times and problems."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from time import monotonic, perf_counter
from typing import Any, Protocol

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from std_msgs.msg import Float64

from lidar_perception.robot.transform_tree import JUMP_NS

OK, WARN, ERROR, STALE = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR, DiagnosticStatus.STALE
WAITING = "waiting for input"
LOG_PERIOD_S = 60.0  # pause before the same problem is logged again
MAX_LOGGED_KINDS = 1000  # maximum number of message kinds whose last log time is stored
TIMED_FRAMES = 100  # number of frames over which the median processing time is computed
SUMMED_COUNTS = ("lost", "dropped")  # values that are summed over all sources

Problem = tuple[str, bytes, str]  # (kind, level, message)


class DiagnosticSource(Protocol):
    """Part of a node that reports its own diagnostic values and problems."""

    def values(self) -> dict[str, Any]:
        """Return the values for the diagnostics."""

    def problems(self) -> list[Problem]:
        """Return the present problems with their remedies."""


class Diagnostics:
    """State, counts, processing times and problems of a node, published on /diagnostics.

    Attributes:
        state: level and message.
        counts: values for the diagnostics.
        frame_id: frame of the last cloud, which identifies the sensor.
        sources: other parts of the node that report values and problems.
    """

    def __init__(self, node: Node):
        self.node = node
        self.sources: list[DiagnosticSource] = []
        self.state = (WARN, WAITING)
        self.reset()
        self._present_kinds: set[str] = set()  # kinds of the present problems
        self._log_times: dict[str, float] = {}  # kind of message -> time when it was last logged
        self._last_logged_kind = ""
        self.publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._processing_time = node.create_publisher(Float64, "~/debug/processing_time_ms", 10)

    def reset(self) -> None:
        """Reset the counts and times."""
        self.counts: dict[str, Any] = {"frames": 0, "lost": 0}
        self.last_stamp_ns = 0
        self.frame_id = ""
        self._times_ms: list[float] = []

    def count_lost(self, event: Any) -> None:
        """Count the messages that the middleware reports as lost."""
        self.counts["lost"] += event.total_count_change

    @contextmanager
    def measure_frame(self, stamp_ns: int) -> Iterator[None]:
        """Count and time the work on one cloud, and detect stamps that jump back."""
        if stamp_ns < self.last_stamp_ns - JUMP_NS:
            self.counts["time_went_back"] = self.counts.get("time_went_back", 0) + 1
            self.node.get_logger().info(
                "time jumped back, for example because a bag has restarted; dropping pending data (logged once, "
                "counted in /diagnostics)",
                once=True,
            )
        self.last_stamp_ns = stamp_ns
        begin = perf_counter()
        yield
        elapsed_ms = (perf_counter() - begin) * 1e3
        self._processing_time.publish(Float64(data=elapsed_ms))
        self._times_ms = [*self._times_ms[1 - TIMED_FRAMES :], elapsed_ms]
        self.counts["frames"] += 1

    def report(self, level: bytes, message: str, expected: bool = False) -> None:
        """Set the state.

        A message that differs from the last one in more than its numbers is logged and published
        immediately. Expected states, such as waiting for input after the start, are logged as
        information.
        """
        kind, previous = _mask_numbers(message), (self.state[0], _mask_numbers(self.state[1]))
        self.state = (level, message)
        if (level, kind) != previous:
            self._log_rarely(kind, OK if expected else level, message)
            self.publish()

    def publish(self) -> None:
        """Publish the state, with the values and problems of all sources."""
        values = dict(self.counts, last_stamp_ns=self.last_stamp_ns)
        for source in self.sources:
            for key, value in source.values().items():
                values[key] = values.get(key, 0) + value if key in SUMMED_COUNTS else value
        if self._times_ms:
            values["processing_ms_median"] = f"{np.median(self._times_ms):.1f}"
        level, message = self.state
        if problems := self.find_problems():
            level = max(level, *(p[1] for p in problems))
            message = f"{'; '.join(p[2] for p in problems)} (state: {message})"
        parts = self.node.get_namespace().strip("/"), self.frame_id
        status = DiagnosticStatus(
            level=level,
            name=self.node.get_fully_qualified_name().lstrip("/"),
            message=message,
            hardware_id="/".join(filter(None, parts)) or "lidar_perception",
            values=[KeyValue(key=k, value=str(v)) for k, v in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.node.get_clock().now().to_msg()
        if rclpy.ok(context=self.node.context):
            self.publisher.publish(array)

    def find_problems(self) -> list[Problem]:
        """Return all present problems and log the new ones."""
        problems = [p for source in self.sources for p in source.problems()]
        name, namespace = self.node.get_name(), self.node.get_namespace()
        if self.node.get_node_names_and_namespaces().count((name, namespace)) > 1:
            message = (
                f"another node is also called {self.node.get_fully_qualified_name()}, "
                "so their topics and parameters are mixed; stop one of them, or change its namespace"
            )
            problems.append(("name", WARN, message))
        previous_kinds, self._present_kinds = self._present_kinds, {kind for kind, _, _ in problems}
        for kind, level, message in problems:
            if kind not in previous_kinds:
                self._log_rarely(kind, level, message)
        return problems

    def _log_rarely(self, kind: str, level: bytes, message: str) -> None:
        """Log a problem at most once per LOG_PERIOD_S, and an OK state unless it was logged last.

        The log therefore always ends with the current state.
        """
        now = monotonic()
        if level == OK:
            is_due = kind != self._last_logged_kind
        else:
            is_due = now - self._log_times.get(kind, -LOG_PERIOD_S) >= LOG_PERIOD_S
        if is_due:
            if len(self._log_times) > MAX_LOGGED_KINDS:
                self._log_times.clear()
            self._log_times[kind], self._last_logged_kind = now, kind
            self._log(level, message)

    def _log(self, level: bytes, message: str) -> None:
        if level == OK:  # separate calls, because rclpy does not allow one line to log at several levels
            self.node.get_logger().info(message)
        elif level == WARN:
            self.node.get_logger().warning(message)
        else:
            self.node.get_logger().error(message)


def _mask_numbers(message: str) -> str:
    """Return the message with all numbers replaced by 0."""
    return re.sub(r"\d[\d.,e+-]*", "0", message)
