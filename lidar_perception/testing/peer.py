"""Node in the test process that communicates with the nodes under test and waits for them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from time import monotonic
from typing import Any

from rcl_interfaces.srv import GetParameters, SetParameters

from lidar_perception.nodes.external_node import ExternalNode, to_parameters, to_values
from lidar_perception.nodes.graph import Graph, find_connected_outputs
from lidar_perception.nodes.interfaces import RELIABLE, QoSProfile
from lidar_perception.testing.processes import NodesUnderTest
from lidar_perception.wire.codec import decode, encode, load_typestore
from msg_utils.messages import load_message_class

__tracebackhide__ = True  # so that pytest shows the line in the test

TIMEOUT_S = 120.0  # default timeout; long, because nodes compile code at their first start on a machine
LEVELS = {0: "OK", 1: "WARN", 2: "ERROR", 3: "STALE"}


class Peer(ExternalNode):
    """Context manager with a node on a ROS domain, by default the domain in the environment.

    A wait fails after the timeout, or at once if one of `processes` has ended with an error. Then
    it raises an AssertionError that describes the received messages.

    Message types are names such as "std_msgs/msg/Bool", or classes. Received messages are objects
    of rosbags, with NumPy arrays, if rosbags knows their type, and otherwise of rclpy.
    """

    def __init__(self, domain: int | None = None, processes: NodesUnderTest | None = None):
        super().__init__(domain, "peer")
        self.processes = processes
        self.subscriptions: list[tuple[str, list]] = []  # topic and messages of each subscription

    def listen(self, topic: str, message_type: str | type, qos: QoSProfile = RELIABLE) -> list:
        """Subscribe to a topic; return a list to which its messages are appended."""
        name, cls = _resolve_type(message_type)
        is_known = name in load_typestore().fielddefs
        return self._listen(topic, cls, (lambda data: decode(data, name)) if is_known else None, qos)

    def listen_raw(self, topic: str, message_type: str | type, qos: QoSProfile = RELIABLE) -> list[bytes]:
        """Subscribe to a topic; return a list to which its serialized messages are appended."""
        return self._listen(topic, _resolve_type(message_type)[1], bytes, qos)

    def _listen(self, topic: str, cls: type, read: Callable[[bytes], Any] | None, qos: QoSProfile) -> list:
        messages: list = []
        self.node.create_subscription(
            cls,
            topic,
            (lambda data: messages.append(read(data))) if read else messages.append,
            qos,
            raw=read is not None,
        )
        self.subscriptions.append((self.node.resolve_topic_name(topic), messages))
        return messages

    def advertise(self, topic: str, message_type: str | type, qos: QoSProfile = RELIABLE) -> Any:
        """Create a publisher for send()."""
        return self.node.create_publisher(_resolve_type(message_type)[1], topic, qos)

    def send(self, publisher: Any, message: Any, condition: Callable[[], Any], description: str) -> None:
        """Publish a message every half second until a condition is true.

        The message is repeated because a best-effort subscriber may not have discovered the
        publisher yet when the publisher discovers it.

        Args:
            publisher: Result of advertise().
            message: Message of a rosbags or rclpy class.
            condition, description: See wait().
        """
        data = encode(message) if hasattr(message, "__msgtype__") else message
        next_time = 0.0

        def publish_until_condition() -> Any:
            nonlocal next_time
            if monotonic() >= next_time and publisher.get_subscription_count():
                publisher.publish(data)
                next_time = monotonic() + 0.5
                return False
            return condition()

        self.wait(publish_until_condition, description)

    def wait(
        self, condition: Callable[[], Any], description: str | Callable[[], str], timeout: float = TIMEOUT_S
    ) -> None:
        """Spin until condition() is true.

        Args:
            condition: Function that returns True when the wait is over.
            description: What the condition waits for, for the error message.
            timeout: Maximum duration in seconds.

        Raises:
            AssertionError: The timeout has expired, or a process has ended with an error.
        """
        is_fulfilled = False

        def is_over() -> bool:
            nonlocal is_fulfilled
            is_fulfilled = bool(condition())
            return is_fulfilled or bool(self._find_failed())

        self.spin_until(is_over, timeout)
        # The condition may be that a process has failed.
        if is_fulfilled or (self._find_failed() and condition()):
            return
        description = description if isinstance(description, str) else description()
        if failures := ", ".join(f"{k} ended with code {v}" for k, v in self._find_failed().items()):
            raise AssertionError(f"while the test waited for {description}, {failures}; {self.describe()}")
        raise AssertionError(f"timed out after {timeout:g} s waiting for {description}; {self.describe()}")

    def _find_failed(self) -> dict[str, int]:
        return self.processes.find_failed() if self.processes else {}

    def wait_for_topics(self, *topics: str, timeout: float = TIMEOUT_S) -> None:
        """Wait until each topic has a publisher."""
        names = [self.node.resolve_topic_name(topic) for topic in topics]

        def list_missing() -> list[str]:
            return [name for name in names if not self.node.count_publishers(name)]

        self.wait(lambda: not list_missing(), lambda: "publishers of " + ", ".join(list_missing()), timeout)

    def wait_for_messages(
        self,
        topic: str,
        message_type: str | type,
        count: int = 1,
        qos: QoSProfile = RELIABLE,
        timeout: float = TIMEOUT_S,
    ) -> list:
        """Subscribe to a topic, wait for `count` messages, and return the list; see listen()."""
        received = self.listen(topic, message_type, qos)
        self.wait(lambda: len(received) >= count, f"{count} messages on {topic}", timeout)
        return received

    def wait_for_diagnostics(
        self, node: str, words: str = "", level: int | None = None, timeout: float = TIMEOUT_S
    ) -> Any:
        """Wait for a diagnostic status of a node and return it.

        Args:
            words: Text that the message must contain.
            level: 0 OK, 1 WARN, 2 ERROR, 3 STALE; None for any level.
        """

        def matches() -> bool:
            status = self.diagnostics.get(node)
            return status is not None and words in status.message and level in (None, ord(status.level))

        description = ("" if level is None else f" of level {LEVELS[level]}") + (f" with '{words}'" if words else "")
        self.wait(matches, f"a diagnostic of {node}{description}", timeout)
        return self.diagnostics[node]

    def wait_for_graph(self, graph: Graph, timeout: float = TIMEOUT_S) -> None:
        """Wait until all nodes of a graph of start_graph() are connected."""
        outputs = find_connected_outputs(graph)
        self.wait(lambda: self.is_connected(outputs), f"{', '.join(graph)} to find each other", timeout)

    def wait_for_subscribers(self, node: str, topic: str, others: int = 0, timeout: float = TIMEOUT_S) -> None:
        """Wait until a node of this package has discovered all subscribers of a topic.

        Subscribers miss messages that are published earlier. The number of subscribers in the
        diagnostics of the node must reach the number of subscribers of this peer plus `others`.
        """
        name = self.node.resolve_topic_name(topic)
        expected_count = others + sum(name == topic_name for topic_name, _ in self.subscriptions)
        self.wait(
            lambda: int(self.get_value(node, f"subscribers of {name}") or 0) >= expected_count,
            f"{expected_count} subscribers of {name}",
            timeout,
        )

    def describe(self) -> str:
        """Return a description of the nodes' diagnostics and of the messages received so far."""
        diagnostics = "; ".join(
            f"{name} {LEVELS[ord(status.level)]} '{status.message}'"
            for name, status in sorted(self.diagnostics.items())
        )
        received = "; ".join(
            f"{topic} {len(messages)} messages"
            if messages
            else f"{topic} no messages from {self.node.count_publishers(topic)} publishers"
            for topic, messages in self.subscriptions
        )
        return f"diagnostics: {diagnostics or 'none'}" + (f"; received: {received}" if received else "")

    def call(self, service: str, service_type: type, request: Any) -> Any:
        """Call a service and return its response."""
        client = self.node.create_client(service_type, service)
        self.wait(client.service_is_ready, f"service {service}")
        future = client.call_async(request)
        self.wait(future.done, f"answer of {service}")
        self.node.destroy_client(client)
        return future.result()

    def set_parameters(self, node: str, values: Mapping[str, Any]) -> list[str]:
        """Set parameters of a node one by one; return the reason for each rejected parameter."""
        request = SetParameters.Request(
            parameters=[parameter.to_parameter_msg() for parameter in to_parameters(values)]
        )
        results = self.call(f"{node}/set_parameters", SetParameters, request).results
        return [result.reason or "no reason is given" for result in results if not result.successful]

    def set_parameter(self, node: str, name: str, value: Any) -> None:
        """Set a parameter of a node.

        Raises:
            AssertionError: The node rejects the value; the message contains the reason.
        """
        assert not (reasons := self.set_parameters(node, {name: value})), reasons

    @contextmanager
    def override_parameters(self, node: str, values: Mapping[str, Any]) -> Iterator[None]:
        """Set parameters of a node within a block and restore the previous values at its end."""
        request = GetParameters.Request(names=list(values))
        previous_values = to_values(self.call(f"{node}/get_parameters", GetParameters, request).values)
        assert not (reasons := self.set_parameters(node, values)), reasons
        try:
            yield
        finally:
            assert not self.set_parameters(node, dict(zip(values, previous_values)))


def _resolve_type(message_type: str | type) -> tuple[str, type]:
    """Return the name and the class of a message type, given either of them."""
    if isinstance(message_type, str):
        return message_type, load_message_class(message_type)
    package, group, *_ = message_type.__module__.split(".")
    return f"{package}/{group}/{message_type.__name__}", message_type
