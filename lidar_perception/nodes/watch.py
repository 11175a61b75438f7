"""Watches a running graph from outside: is it connected, how far is it, how long does it take."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Mapping
from time import monotonic
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from lidar_perception.nodes.runtime import RELIABLE, SENSOR_DATA
from lidar_perception.topics import POINTS


class Watch:
    """A node of its own context on a private domain; a context manager."""

    def __init__(self, domain: int, detections: str):
        self.context = Context()
        previous = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE")
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        rclpy.init(context=self.context, domain_id=domain,
                   signal_handler_options=SignalHandlerOptions.NO)
        self.node = rclpy.create_node("watch", context=self.context)
        if previous is None:
            del os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"]
        else:
            os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = previous
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.status: dict[str, dict[str, str]] = {}
        self.messages: dict[str, str] = {}
        self.sent: dict[bytes, float] = {}
        self.latencies_ms: list[float] = []
        self.frames = 0
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_status, RELIABLE)
        self.node.create_subscription(PointCloud2, POINTS, self._on_cloud, SENSOR_DATA, raw=True)
        self.node.create_subscription(MarkerArray, detections, self._on_detections, RELIABLE)

    def __enter__(self) -> Watch:
        return self

    def __exit__(self, *_: Any) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)

    def _on_status(self, msg: Any) -> None:
        for status in msg.status:
            self.status[status.name] = {v.key: v.value for v in status.values}
            self.messages[status.name] = status.message

    def _on_cloud(self, data: bytes) -> None:
        self.sent[data[4:12]] = monotonic()  # CDR: 4 bytes of encapsulation, then header.stamp

    def _on_detections(self, msg: Any) -> None:
        self.frames += 1
        stamp = msg.markers[0].header.stamp if msg.markers else None
        sent = stamp and self.sent.pop(struct.pack("<iI", stamp.sec, stamp.nanosec), None)
        if sent:
            self.latencies_ms.append((monotonic() - sent) * 1e3)

    def until(self, condition: Callable[[], bool], timeout: float,
              each: Callable[[], None] = lambda: None) -> bool:
        """Spin until condition() holds (True) or timeout seconds have gone by (False); each() is
        called again and again."""
        end = monotonic() + timeout
        while not condition():
            if monotonic() > end:
                return False
            each()
            self.executor.spin_once(timeout_sec=0.05)
        return True

    def connected(self, outputs: Mapping[str, set[str]]) -> bool:
        """True once every node has said by its diagnostics that somebody listens to each of its
        outputs in use."""
        return all(node in self.status and all(
            int(self.status[node].get(f"subscribers of {topic}", 0)) for topic in topics)
            for node, topics in outputs.items())
