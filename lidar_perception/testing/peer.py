"""A node in the test process that talks to the nodes under test and waits for them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from time import monotonic
from typing import Any

from rcl_interfaces.srv import GetParameters, SetParameters

from lidar_perception.nodes.external_node import ExternalNode, to_parameters, to_values
from lidar_perception.nodes.graph import Graph, find_connected_outputs
from lidar_perception.nodes.runtime import RELIABLE, QoSProfile
from lidar_perception.testing.processes import NodesUnderTest
from lidar_perception.wire.codec import decode, encode, load_typestore
from msg_utils.messages import load_message_class

__tracebackhide__ = True  # so that pytest shows the line in the test

TIMEOUT_S = 120.0  # the first start on a machine compiles code, and the machine may be busy
LEVELS = {0: "OK", 1: "WARN", 2: "ERROR", 3: "STALE"}


class Peer(ExternalNode):
    """Talks over DDS on a domain, by default that of the environment. A context manager.

    A wait that fails raises an AssertionError that describes the messages received: after the
    timeout, or at once if one of `processes` has ended with an error.

    Types of messages are names such as "std_msgs/msg/Bool", or classes. Received messages are of
    rosbags' classes, with NumPy arrays, if rosbags knows the type; else of rclpy's classes.
    """

    def __init__(self, domain: int | None = None, processes: NodesUnderTest | None = None):
        super().__init__(domain, "peer")
        self.processes = processes
        self.received: list[tuple[str, list]] = []  # topic and messages of each subscription

    def listen(self, topic: str, kind: str | type, qos: QoSProfile = RELIABLE) -> list:
        """Subscribe to a topic; return a list that grows with its messages."""
        name, cls = _resolve_type(kind)
        known = name in load_typestore().fielddefs
        return self._listen(topic, cls, (lambda data: decode(data, name)) if known else None, qos)

    def listen_raw(self, topic: str, kind: str | type, qos: QoSProfile = RELIABLE) -> list[bytes]:
        """Subscribe to a topic; return a list that grows with the serialized messages."""
        return self._listen(topic, _resolve_type(kind)[1], bytes, qos)

    def _listen(self, topic: str, cls: type, read: Callable[[bytes], Any] | None, qos: QoSProfile) -> list:
        received: list = []
        self.node.create_subscription(
            cls,
            topic,
            (lambda data: received.append(read(data))) if read else received.append,
            qos,
            raw=read is not None,
        )
        self.received.append((self.node.resolve_topic_name(topic), received))
        return received

    def advertise(self, topic: str, kind: str | type, qos: QoSProfile = RELIABLE) -> Any:
        """Return a publisher for send()."""
        return self.node.create_publisher(_resolve_type(kind)[1], topic, qos)

    def send(self, publisher: Any, message: Any, until: Callable[[], Any], what: str) -> None:
        """Publish a message of rosbags' or rclpy's classes until a condition holds.

        It is published every half second, because a best-effort subscriber may not have discovered
        the publisher when the publisher has discovered it. `what` describes the condition.
        """
        data = encode(message) if hasattr(message, "__msgtype__") else message
        next_time = 0.0

        def condition() -> Any:
            nonlocal next_time
            if monotonic() >= next_time and publisher.get_subscription_count():
                publisher.publish(data)
                next_time = monotonic() + 0.5
                return False
            return until()

        self.wait(condition, what)

    def wait(self, condition: Callable[[], Any], what: str | Callable[[], str], timeout: float = TIMEOUT_S) -> None:
        """Spin until condition() holds; `what` describes it.

        Raises:
            AssertionError: after the timeout, or if a process ended with an error.
        """
        fulfilled = False

        def is_over() -> bool:
            nonlocal fulfilled
            fulfilled = bool(condition())
            return fulfilled or bool(self._find_failed())

        self.spin_until(is_over, timeout)
        # The condition may be that the process ends.
        if fulfilled or (self._find_failed() and condition()):
            return
        what = what if isinstance(what, str) else what()
        if ended := ", ".join(f"{k} ended with code {v}" for k, v in self._find_failed().items()):
            raise AssertionError(f"while the test waited for {what}, {ended}; {self.describe()}")
        raise AssertionError(f"waited {timeout:g} s in vain for {what}; {self.describe()}")

    def _find_failed(self) -> dict[str, int]:
        return self.processes.find_failed() if self.processes else {}

    def wait_for_topics(self, *topics: str, timeout: float = TIMEOUT_S) -> None:
        """Wait until each topic has a publisher."""
        names = [self.node.resolve_topic_name(topic) for topic in topics]

        def missing() -> list[str]:
            return [name for name in names if not self.node.count_publishers(name)]

        self.wait(lambda: not missing(), lambda: "publishers of " + ", ".join(missing()), timeout)

    def wait_for_messages(
        self, topic: str, kind: str | type, count: int = 1, qos: QoSProfile = RELIABLE, timeout: float = TIMEOUT_S
    ) -> list:
        """Subscribe to a topic and wait for `count` messages; the list continues to grow."""
        received = self.listen(topic, kind, qos)
        self.wait(lambda: len(received) >= count, f"{count} messages on {topic}", timeout)
        return received

    def wait_for_diagnostics(
        self, node: str, words: str = "", level: int | None = None, timeout: float = TIMEOUT_S
    ) -> Any:
        """Wait until the node's diagnostic has these words and this level; return the status.

        level: 0 OK, 1 WARN, 2 ERROR, 3 STALE; None for any.
        """

        def matches() -> bool:
            status = self.diagnostics.get(node)
            return status is not None and words in status.message and level in (None, ord(status.level))

        wanted = ("" if level is None else f" of level {LEVELS[level]}") + (f" with '{words}'" if words else "")
        self.wait(matches, f"a diagnostic of {node}{wanted}", timeout)
        return self.diagnostics[node]

    def wait_for_graph(self, graph: Graph, timeout: float = TIMEOUT_S) -> None:
        """Wait until all nodes of a graph, as start_graph() returns it, are connected."""
        outputs = find_connected_outputs(graph)
        self.wait(lambda: self.is_connected(outputs), f"{', '.join(graph)} to find each other", timeout)

    def wait_for_subscribers(self, node: str, topic: str, others: int = 0, timeout: float = TIMEOUT_S) -> None:
        """Wait until a node of this package has discovered all subscribers of its topic.

        These are the peer's own subscribers and `others`, by the node's diagnostics. They miss
        messages that are published earlier.
        """
        name = self.node.resolve_topic_name(topic)
        wanted = others + sum(name == subscribed for subscribed, _ in self.received)
        self.wait(
            lambda: int(self.get_value(node, f"subscribers of {name}") or 0) >= wanted,
            f"{wanted} subscribers of {name}",
            timeout,
        )

    def describe(self) -> str:
        """Describe the diagnostics of the nodes and the messages received so far."""
        diagnostics = "; ".join(
            f"{name} {LEVELS[ord(status.level)]} '{status.message}'"
            for name, status in sorted(self.diagnostics.items())
        )
        received = "; ".join(
            f"{topic} {len(messages)} messages"
            if messages
            else f"{topic} nothing from {self.node.count_publishers(topic)} publishers"
            for topic, messages in self.received
        )
        return f"diagnostics: {diagnostics or 'none'}" + (f"; received: {received}" if received else "")

    def call(self, service: str, kind: type, request: Any) -> Any:
        """Call a service and return its answer."""
        client = self.node.create_client(kind, service)
        self.wait(client.service_is_ready, f"service {service}")
        future = client.call_async(request)
        self.wait(future.done, f"answer of {service}")
        self.node.destroy_client(client)
        return future.result()

    def set_parameters(self, node: str, values: Mapping[str, Any]) -> list[str]:
        """Set parameters of a node one by one; return its reasons for those that it refuses."""
        request = SetParameters.Request(
            parameters=[parameter.to_parameter_msg() for parameter in to_parameters(values)]
        )
        results = self.call(f"{node}/set_parameters", SetParameters, request).results
        return [r.reason or "no reason is given" for r in results if not r.successful]

    def set_parameter(self, node: str, name: str, value: Any) -> None:
        """Set a parameter of a node; raise AssertionError with the node's reason if it refuses."""
        assert not (refused := self.set_parameters(node, {name: value})), refused

    @contextmanager
    def parameters(self, node: str, values: Mapping[str, Any]) -> Iterator[None]:
        """Set parameters of a node within a block; the previous values are restored at its end."""
        request = GetParameters.Request(names=list(values))
        before = to_values(self.call(f"{node}/get_parameters", GetParameters, request).values)
        assert not (refused := self.set_parameters(node, values)), refused
        try:
            yield
        finally:
            assert not self.set_parameters(node, dict(zip(values, before)))


def _resolve_type(kind: str | type) -> tuple[str, type]:
    """Return the name and the class of a message type."""
    if isinstance(kind, str):
        return kind, load_message_class(kind)
    package, group, *_ = kind.__module__.split(".")
    return f"{package}/{group}/{kind.__name__}", kind
