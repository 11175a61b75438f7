"""ROS nodes for programs that start and observe other nodes."""

from __future__ import annotations

import os
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
from visualization_msgs.msg import MarkerArray

from lidar_perception.nodes.interfaces import RELIABLE

DISCOVERY_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
SETTLE_S, MAX_SETTLE_S = 0.1, 3.0  # time without changes after which the ROS graph has settled, and its limit


def create_context(domain: int | None) -> Context:
    """Create a ROS context without signal handlers. End it with shut_down_context().

    domain: ROS domain; None for the domain of the environment.
    """
    context = Context()
    rclpy.init(context=context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    return context


def to_parameters(values: Mapping[str, Any]) -> list[Parameter]:
    """Convert {name: value} to rclpy parameters."""
    return [Parameter(name, value=value) for name, value in values.items()]


def to_values(answers: Iterable[Any]) -> list[Any]:
    """Convert the parameter messages of a get_parameters response to Python values."""
    return [parameter_value_to_python(answer) for answer in answers]


def shut_down_context(context: Context, *nodes: Node) -> None:
    """Destroy all nodes of a context and shut it down once the ROS graph has settled.

    The graph has settled after SETTLE_S seconds without a change, at the latest after MAX_SETTLE_S.
    The Fast DDS of the wheels may deadlock while it holds the interpreter lock, if the last node of
    a context is destroyed while Fast DDS is notified that another process has left
    (https://github.com/eProsima/Fast-DDS/issues/6513).
    """
    if nodes:
        end, last_change, state = monotonic() + MAX_SETTLE_S, monotonic(), _read_graph_state(nodes[0])
        while (now := monotonic()) < min(end, last_change + SETTLE_S):
            sleep(SETTLE_S / 10)
            if state != (state := _read_graph_state(nodes[0])):
                last_change = now
    for node in nodes:
        node.destroy_node()
    context.try_shutdown()


def _read_graph_state(node: Node) -> tuple[Any, ...]:
    """Return the nodes on the domain, and the numbers of publishers and subscribers of each topic."""
    return (
        sorted(node.get_node_names_and_namespaces()),
        [
            (topic, node.count_publishers(topic), node.count_subscribers(topic))
            for topic, _ in node.get_topic_names_and_types()
        ],
    )


class ExternalNode:
    """Context manager for a node in a program that starts or observes other nodes.

    The node has its own ROS context without signal handlers and is spun by spin_until().

    Args:
        domain: ROS domain; None for the domain of the environment.
        name: name of the node.

    Attributes:
        diagnostics: {node: its last DiagnosticStatus}
        poll_s: maximum time between two checks of the condition in spin_until(); a message triggers
            an earlier check.
    """

    poll_s = 0.02

    def __init__(self, domain: int | None, name: str):
        self.context = create_context(domain)
        self.node = rclpy.create_node(name, context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.diagnostics: dict[str, Any] = {}
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_status, RELIABLE)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        self.executor.shutdown()
        shut_down_context(self.context, self.node)

    def _on_status(self, msg: Any) -> None:
        for status in msg.status:
            self.diagnostics[status.name] = status

    def get_message(self, node: str) -> str:
        """Return the last diagnostic message of a node; "" if there is none yet."""
        return self.diagnostics[node].message if node in self.diagnostics else ""

    def get_value(self, node: str, key: str) -> str | None:
        """Return a value from the last diagnostic status of a node, or None."""
        status = self.diagnostics.get(node)
        return next((v.value for v in status.values if v.key == key), None) if status else None

    def is_connected(self, outputs: Mapping[str, set[str]]) -> bool:
        """Return True if every output {node: topics} has a subscriber, according to the diagnostics."""
        return all(
            node in self.diagnostics
            and all(int(self.get_value(node, f"subscribers of {topic}") or 0) for topic in topics)
            for node, topics in outputs.items()
        )

    def spin_until(
        self, condition: Callable[[], Any], timeout: float, on_spin: Callable[[], None] = lambda: None
    ) -> bool:
        """Spin until condition() is true; return False after `timeout` seconds.

        on_spin() is called before each spin.
        """
        end = monotonic() + timeout
        while not condition():
            if monotonic() > end:
                return False
            on_spin()
            self.executor.spin_once(timeout_sec=self.poll_s)
        return True


class GraphMonitor(ExternalNode):
    """Node that counts the results of a running graph.

    Args:
        domain: ROS domain of the graph.
        detections: topic of the detections to count.

    Attributes:
        frames: number of results so far.
    """

    poll_s = 0.1

    def __init__(self, domain: int, detections: str):
        with _limit_discovery_to_localhost():
            super().__init__(domain, "watch")
        self.frames = 0
        on_detections: Any = self._on_detections  # raw: CDR
        self.node.create_subscription(MarkerArray, detections, on_detections, RELIABLE, raw=True)

    def _on_detections(self, _: bytes) -> None:
        self.frames += 1


@contextmanager
def _limit_discovery_to_localhost():
    """Limit discovery to this machine for contexts that are created inside the with block."""
    previous = os.environ.get(DISCOVERY_RANGE)
    os.environ[DISCOVERY_RANGE] = "LOCALHOST"
    try:
        yield
    finally:
        if previous is None:
            del os.environ[DISCOVERY_RANGE]
        else:
            os.environ[DISCOVERY_RANGE] = previous
