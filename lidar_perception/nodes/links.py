"""Outputs of nodes, and links that pass messages within a process without serializing them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from time import time_ns
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

from lidar_perception.nodes.diagnostics import Problem
from lidar_perception.nodes.interfaces import RELIABLE
from lidar_perception.wire.array_codec import encode_markers
from lidar_perception.wire.codec import encode, warm_up_type
from msg_utils.markers import MarkerRows
from msg_utils.messages import load_message_class

Receive = Callable[[Any, dict[str, int]], None]  # function that receives a message and its message info


class Output:
    """A publisher that also passes its messages to linked nodes in the same process.

    Messages are rosbags messages, MarkerRows or CDR. Linked nodes share them and must not modify
    them. Messages are serialized and published on DDS only while there are subscribers in other
    processes, or always if the process has one node.

    Args:
        publisher: publisher of rclpy.
        links: links of the process; None if it has one node.
    """

    def __init__(self, publisher: Any, links: Links | None):
        self.publisher, self.links = publisher, links
        self.receivers: tuple[Receive, ...] = ()
        self.count = 0  # number of messages passed to linked nodes
        is_latched = publisher.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        self.always_publishes = links is None or is_latched
        if links is not None:
            links.add(self)

    @property
    def topic_name(self) -> str:
        name: str = self.publisher.topic_name
        return name

    def get_subscription_count(self) -> int:
        """Return the number of subscribers inside and outside the process."""
        return len(self.receivers) + int(self.publisher.get_subscription_count())

    def publish(self, message: Any) -> None:
        if receivers := self.receivers:
            self.count += 1
            info = {"publication_sequence_number": self.count, "source_timestamp": time_ns()}
            for receive in receivers:
                receive(message, info)
        if self.always_publishes or self.publisher.get_subscription_count():
            self.publisher.publish(to_cdr(message))


class Outputs:
    """The outputs of a node."""

    def __init__(self, node: Node, links: Links | None):
        self.node, self.links = node, links
        self.items: list[Output] = []

    def advertise(self, topic: str, type_name: str, qos: QoSProfile = RELIABLE) -> Output:
        """Create a publisher of ~/output/TOPIC, or of the topic itself if it starts with ~ or /."""
        warm_up_type(type_name)
        publisher = self.node.create_publisher(
            load_message_class(type_name),
            topic if topic[0] in "~/" else f"~/output/{topic}",
            qos,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        self.items.append(Output(publisher, self.links))
        return self.items[-1]

    def clear(self) -> None:
        """Remove all outputs and their links; their publishers are destroyed elsewhere."""
        if self.links is not None:
            for output in self.items:
                self.links.remove(output)
        self.items = []

    def values(self) -> dict[str, Any]:
        """Return the numbers of subscribers for the diagnostics."""
        return {f"subscribers of {output.topic_name}": output.get_subscription_count() for output in self.items}

    def problems(self) -> list[Problem]:
        """Return an empty list, because missing subscribers are normal."""
        return []


def to_cdr(message: Any) -> bytes:
    """Return the CDR of a message of an Output."""
    if isinstance(message, bytes):
        return message
    if isinstance(message, MarkerRows):
        return encode_markers(message.rows, message.header, message.lifetime_ns)
    return encode(message)


def find_only_output(node: Node, links: Links | None, topic: str) -> Output | None:
    """Return the output of this process that is the only publisher of a topic, or None."""
    output = None if links is None else links.find_output(topic)
    return output if output is not None and len(node.get_publishers_info_by_topic(topic)) < 2 else None


class Links:
    """Outputs of all nodes of a process, and callbacks of the inputs that may be linked to them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._outputs: dict[str, tuple[Output, ...]] = {}
        self._watchers: dict[str, tuple[Callable[[], None], ...]] = {}  # topic -> callbacks of watch()

    def add(self, output: Output) -> None:
        """Add an output and notify the inputs of its topic."""
        topic = output.topic_name
        with self._lock:
            self._outputs[topic] = (*self._outputs.get(topic, ()), output)
        self._notify(topic)

    def remove(self, output: Output) -> None:
        """Remove an output and notify the inputs of its topic."""
        topic = output.topic_name
        with self._lock:
            self._outputs[topic] = tuple(o for o in self._outputs.get(topic, ()) if o is not output)
            output.receivers = ()
        self._notify(topic)

    def _notify(self, topic: str) -> None:
        for on_change in self._watchers.get(topic, ()):
            on_change()

    def watch(self, topic: str, on_change: Callable[[], None]) -> None:
        """Call on_change(), in any thread, when an output of the topic is added or removed."""
        with self._lock:
            self._watchers[topic] = (*self._watchers.get(topic, ()), on_change)

    def unwatch(self, topic: str, on_change: Callable[[], None]) -> None:
        """Stop calling on_change(), see watch()."""
        with self._lock:
            self._watchers[topic] = tuple(c for c in self._watchers.get(topic, ()) if c != on_change)

    def find_output(self, topic: str) -> Output | None:
        """Return the output of a topic if this process has exactly one; otherwise None."""
        outputs = self._outputs.get(topic, ())
        return outputs[0] if len(outputs) == 1 else None

    def connect(self, output: Output, receive: Receive) -> None:
        """Pass the messages of an output to receive(), in the thread of the publisher."""
        with self._lock:
            output.receivers = (*output.receivers, receive)

    def disconnect(self, output: Output, receive: Receive) -> None:
        with self._lock:
            output.receivers = tuple(r for r in output.receivers if r != receive)
