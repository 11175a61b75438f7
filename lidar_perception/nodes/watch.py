"""Watches a running graph from outside: is it connected, how far is it, how long does it take."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterable, Mapping
from contextlib import contextmanager
from time import monotonic, sleep
from typing import Any, Self

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from lidar_perception.nodes.runtime import RELIABLE, SENSOR_DATA
from lidar_perception.wire.topics import POINTS

DISCOVERY_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
STILL, STILL_AT_LAST = 0.1, 3.0  # seconds


def new_context(domain: int | None) -> Context:
    """A ROS context of its own, without signal handlers, on a domain; None is that of the
    environment. leave() ends it."""
    context = Context()
    rclpy.init(context=context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    return context


def parameters_of(values: Mapping[str, Any]) -> list[Parameter]:
    """What sets parameters of these names to these values."""
    return [Parameter(name, value=value) for name, value in values.items()]


def values_of(answers: Iterable[Any]) -> list[Any]:
    """The values in a node's answers to get_parameters."""
    return [parameter_value_to_python(answer) for answer in answers]


def leave(context: Context, *nodes: Node) -> None:
    """Destroy nodes, all that the context has, and end it, once nobody has come or gone for STILL
    seconds, or after STILL_AT_LAST.

    Fast DDS as in the wheels may wait for ever, with the interpreter's lock held, if the last node
    of a context is destroyed in the moment in which it hears that another process leaves
    (https://github.com/eProsima/Fast-DDS/issues/6513).
    """
    if nodes:
        end, since, seen = monotonic() + STILL_AT_LAST, monotonic(), _others(nodes[0])
        while (now := monotonic()) < min(end, since + STILL):
            sleep(STILL / 10)
            if seen != (seen := _others(nodes[0])):
                since = now
    for node in nodes:
        node.destroy_node()
    context.try_shutdown()


def _others(node: Node) -> tuple[Any, ...]:
    """Who is on the domain, and how many publish and subscribe to each topic."""
    return (sorted(node.get_node_names_and_namespaces()),
            [(topic, node.count_publishers(topic), node.count_subscribers(topic))
             for topic, _ in node.get_topic_names_and_types()])


class Outside:
    """A node of a program that starts other nodes: a ROS context of its own, spun by hand, no
    signal handlers; on a domain, None for that of the environment. A context manager. diagnostics
    holds the last status of every node."""

    def __init__(self, domain: int | None, name: str):
        self.context = new_context(domain)
        self.node = rclpy.create_node(name, context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.diagnostics: dict[str, Any] = {}
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_status, RELIABLE)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        self.executor.shutdown()
        leave(self.context, self.node)

    def _on_status(self, msg: Any) -> None:
        for status in msg.status:
            self.diagnostics[status.name] = status

    def message_of(self, node: str) -> str:
        """The node's last diagnostic message, '' before the first."""
        return self.diagnostics[node].message if node in self.diagnostics else ""

    def value_of(self, node: str, key: str) -> str | None:
        """A value of the node's last diagnostic; None where there is none."""
        status = self.diagnostics.get(node)
        return next((v.value for v in status.values if v.key == key), None) if status else None

    def connected(self, outputs: Mapping[str, set[str]]) -> bool:
        """True once every node has said by its diagnostics that somebody listens to each of its
        outputs in use."""
        return all(node in self.diagnostics and all(
            int(self.value_of(node, f"subscribers of {topic}") or 0) for topic in topics)
            for node, topics in outputs.items())

    def until(self, condition: Callable[[], Any], timeout: float,
              each: Callable[[], None] = lambda: None) -> bool:
        """Spin until condition() holds (True) or timeout seconds have gone by (False); each() is
        called again and again."""
        end = monotonic() + timeout
        while not condition():
            if monotonic() > end:
                return False
            each()
            self.executor.spin_once(timeout_sec=0.02)
        return True


class Watch(Outside):
    """How far a running graph is: results, and their latency."""

    def __init__(self, domain: int, detections: str):
        with _localhost():
            super().__init__(domain, "watch")
        self.sent: dict[bytes, float] = {}
        self.latencies_ms: list[float] = []
        self.frames = 0
        self.node.create_subscription(PointCloud2, POINTS, self._on_cloud, SENSOR_DATA, raw=True)
        self.node.create_subscription(MarkerArray, detections, self._on_detections, RELIABLE)

    def _on_cloud(self, data: bytes) -> None:
        self.sent[data[4:12]] = monotonic()  # CDR: 4 bytes of encapsulation, then header.stamp

    def _on_detections(self, msg: Any) -> None:
        self.frames += 1
        stamp = msg.markers[0].header.stamp if msg.markers else None
        sent = stamp and self.sent.pop(struct.pack("<iI", stamp.sec, stamp.nanosec), None)
        if sent:
            self.latencies_ms.append((monotonic() - sent) * 1e3)


@contextmanager
def _localhost():
    """ROS reads the range of discovery from the environment when a context is made."""
    before = os.environ.get(DISCOVERY_RANGE)
    os.environ[DISCOVERY_RANGE] = "LOCALHOST"
    yield
    if before is None:
        del os.environ[DISCOVERY_RANGE]
    else:
        os.environ[DISCOVERY_RANGE] = before
