"""A node in the test's own process, to talk to the nodes under test and to wait for them."""

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
from msg_utils.messages import message_class

__tracebackhide__ = True  # pytest shows the line of the test that waited

TIMEOUT = 120.0  # seconds; the first start on a machine compiles, and it may have other work
LEVELS = {0: "OK", 1: "WARN", 2: "ERROR", 3: "STALE"}


class Peer(ExternalNode):
    """Talks over DDS on a domain (None: that of the environment); a context manager. Each wait ends
    with an AssertionError that says what was seen instead: after its time limit, or at once where
    one of `processes` has ended with an error.

    Types of messages are names such as "std_msgs/msg/Bool", or classes. What is received are
    rosbags' classes, with NumPy arrays, of all types that rosbags knows; else rclpy's.
    """

    def __init__(self, domain: int | None = None, processes: NodesUnderTest | None = None):
        super().__init__(domain, "peer")
        self.processes = processes
        self.heard: list[tuple[str, list]] = []  # what is listened to, with what came

    def listen(self, topic: str, kind: str | type, qos: QoSProfile = RELIABLE) -> list:
        """A list that grows with the messages of a topic."""
        name, cls = _named(kind)
        known = name in load_typestore().fielddefs
        return self._listen(topic, cls, (lambda data: decode(data, name)) if known else None, qos)

    def listen_raw(self, topic: str, kind: str | type, qos: QoSProfile = RELIABLE) -> list[bytes]:
        """The same, with the bytes of the messages."""
        return self._listen(topic, _named(kind)[1], bytes, qos)

    def _listen(self, topic: str, cls: type, read: Callable[[bytes], Any] | None,
                qos: QoSProfile) -> list:
        received: list = []
        self.node.create_subscription(
            cls, topic, (lambda data: received.append(read(data))) if read else received.append,
            qos, raw=read is not None)
        self.heard.append((self.node.resolve_topic_name(topic), received))
        return received

    def talker(self, topic: str, kind: str | type, qos: QoSProfile = RELIABLE) -> Any:
        """A publisher, for send()."""
        return self.node.create_publisher(_named(kind)[1], topic, qos)

    def send(self, publisher: Any, message: Any, until: Callable[[], Any], what: str) -> None:
        """Publish, and again every half second, until a condition holds: a best-effort subscriber
        may not know the publisher yet when the publisher knows it. Of either kind of classes."""
        data, again = encode(message) if hasattr(message, "__msgtype__") else message, 0.0

        def condition() -> Any:
            nonlocal again
            if monotonic() >= again and publisher.get_subscription_count():
                publisher.publish(data)
                again = monotonic() + 0.5
                return False
            return until()

        self.wait(condition, what)

    def wait(self, condition: Callable[[], Any], what: str | Callable[[], str],
             timeout: float = TIMEOUT) -> None:
        """Spin until condition() holds. AssertionError names what was waited for, and what was
        seen."""
        met = False

        def over() -> bool:
            nonlocal met
            met = bool(condition())
            return met or bool(self._failed())

        self.spin_until(over, timeout)
        if met or (self._failed() and condition()):  # it may have been the end that was waited for
            return
        what = what if isinstance(what, str) else what()
        if ended := ", ".join(f"{k} with code {v}" for k, v in self._failed().items()):
            raise AssertionError(f"while the test waited for {what}, there ended {ended}; "
                                 f"{self.seen()}")
        raise AssertionError(f"waited {timeout:g} s in vain for {what}; {self.seen()}")

    def _failed(self) -> dict[str, int]:
        return self.processes.failed() if self.processes else {}

    def wait_for_topics(self, *topics: str, timeout: float = TIMEOUT) -> None:
        """Until each has a publisher."""
        names = [self.node.resolve_topic_name(topic) for topic in topics]

        def missing() -> list[str]:
            return [name for name in names if not self.node.count_publishers(name)]

        self.wait(lambda: not missing(), lambda: "publishers of " + ", ".join(missing()),
                  timeout)

    def wait_for_messages(self, topic: str, kind: str | type, count: int = 1,
                          qos: QoSProfile = RELIABLE, timeout: float = TIMEOUT) -> list:
        """Listen to a topic until so many messages have come; the list goes on growing."""
        received = self.listen(topic, kind, qos)
        self.wait(lambda: len(received) >= count, f"{count} messages on {topic}", timeout)
        return received

    def wait_for_diagnostics(self, node: str, words: str = "", level: int | None = None,
                             timeout: float = TIMEOUT) -> Any:
        """Until the node's diagnostic holds these words and has this level (0 OK, 1 WARN, 2 ERROR,
        3 STALE; None: any). Returns the status."""
        def holds() -> bool:
            status = self.diagnostics.get(node)
            return (status is not None and words in status.message
                    and level in (None, ord(status.level)))

        wanted = ("" if level is None else f" of level {LEVELS[level]}") + (
            f" with '{words}'" if words else "")
        self.wait(holds, f"a diagnostic of {node}{wanted}", timeout)
        return self.diagnostics[node]

    def wait_for_graph(self, graph: Graph, timeout: float = TIMEOUT) -> None:
        """Until all nodes of a graph, as start_graph() returns it, are up and connected."""
        outputs = find_connected_outputs(graph)
        self.wait(lambda: self.is_connected(outputs), f"{', '.join(graph)} to find each other",
                  timeout)

    def wait_for_subscribers(self, node: str, topic: str, others: int = 0,
                             timeout: float = TIMEOUT) -> None:
        """Until a node of ours knows, by its diagnostics, all that this peer has of listeners to
        its topic, and so many others: what it publishes before, these do not get."""
        name = self.node.resolve_topic_name(topic)
        wanted = others + sum(name == heard for heard, _ in self.heard)
        self.wait(lambda: int(self.get_value(node, f"subscribers of {name}") or 0) >= wanted,
                  f"{wanted} subscribers of {name}", timeout)

    def seen(self) -> str:
        """What the nodes say of themselves, and what has come on the topics listened to."""
        said = "; ".join(f"{name} {LEVELS[ord(status.level)]} '{status.message}'"
                         for name, status in sorted(self.diagnostics.items()))
        heard = "; ".join(
            f"{topic} {len(messages)} messages" if messages else f"{topic} nothing from "
            f"{self.node.count_publishers(topic)} publishers" for topic, messages in self.heard)
        return f"diagnostics: {said or 'none came'}" + (f"; heard: {heard}" if heard else "")

    def call(self, service: str, kind: type, request: Any) -> Any:
        """The answer of a service."""
        client = self.node.create_client(kind, service)
        self.wait(client.service_is_ready, f"service {service}")
        future = client.call_async(request)
        self.wait(future.done, f"answer of {service}")
        self.node.destroy_client(client)
        return future.result()

    def change(self, node: str, values: Mapping[str, Any]) -> list[str]:
        """Set parameters of a node, each by itself; its reasons where it refuses."""
        request = SetParameters.Request(
            parameters=[parameter.to_parameter_msg() for parameter in to_parameters(values)])
        results = self.call(f"{node}/set_parameters", SetParameters, request).results
        return [r.reason or "no reason is given" for r in results if not r.successful]

    def set_parameter(self, node: str, name: str, value: Any) -> None:
        """AssertionError with the node's reason if it refuses."""
        assert not (refused := self.change(node, {name: value})), refused

    @contextmanager
    def parameters(self, node: str, values: Mapping[str, Any]) -> Iterator[None]:
        """Other parameters for a while; those from before come back at the end."""
        request = GetParameters.Request(names=list(values))
        before = to_values(self.call(f"{node}/get_parameters", GetParameters, request).values)
        assert not (refused := self.change(node, values)), refused
        try:
            yield
        finally:
            assert not self.change(node, dict(zip(values, before)))


def _named(kind: str | type) -> tuple[str, type]:
    """The name and the class of a message type."""
    if isinstance(kind, str):
        return kind, message_class(kind)
    package, group, *_ = kind.__module__.split(".")
    return f"{package}/{group}/{kind.__name__}", kind
