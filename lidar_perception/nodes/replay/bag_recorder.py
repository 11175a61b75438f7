"""Node that records topics to an MCAP bag, for systems without ros2 bag."""

from __future__ import annotations

import os
import queue
import sys
import threading
from functools import partial
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from lidar_perception.data.bag import BagWriter
from lidar_perception.data.bag_metadata import LATCHED_QOS, SENSOR_QOS
from lidar_perception.nodes.diagnostics import OK, WARN
from lidar_perception.nodes.links import Output, Receive, find_only_output, to_cdr
from lidar_perception.nodes.runtime import LidarNode
from lidar_perception.params import RecorderParams
from lidar_perception.types import InputError
from lidar_perception.wire.codec import load_typestore
from msg_utils.messages import load_message_class

LATCHED = DurabilityPolicy.TRANSIENT_LOCAL
DEPTH = 100  # queue depth of each subscription, large enough for a busy machine
MAX_QUEUED_BYTES = 256 * 2**20  # maximum size of the queue; further messages are dropped and counted
WRITER_NICENESS = 10  # added to that of the nodes, whose results would be late if compression took their core
DISCOVERY_PERIOD_S = 0.2  # pause between searches for publishers of the remaining topics


class BagRecorder(LidarNode):
    """Writes messages to a bag, which is complete when the node has ended.

    A separate thread compresses and writes them. Messages of nodes in the same process arrive
    through links, see links.py; that thread also serializes them.
    """

    writes_files = True

    def __init__(self, **options: Any):
        super().__init__("bag_recorder", RecorderParams(), **options)
        if not self.params.bag or not self.params.topics:
            raise InputError("parameters 'bag' and 'topics' are required")
        self.writer = BagWriter(self.params.bag, compression=self.params.compression)
        self.writer.__enter__()
        self.waiting_topics = list(dict.fromkeys(map(self.resolve_topic_name, self.params.topics)))
        self.class_by_topic: dict[str, type] = {}  # message class of each recorded topic
        self.subscription_by_topic: dict[str, Any] = {}
        self.link_by_topic: dict[str, tuple[Output, Receive]] = {}
        self.incompatible: set[str] = set()  # topics with a publisher of weaker QoS
        self.queue: queue.Queue = queue.Queue()
        # Of messages from links, only clouds count. Each counter is changed by one thread or under the lock.
        self.queued_bytes, self.written_bytes = 0, 0
        self.lock = threading.Lock()
        self.diagnostics.counts.update(lost=0, dropped=0)
        self.reported_count = 0  # number of lost and dropped messages already reported
        self.failure: Exception | None = None
        self.thread = threading.Thread(target=self._write)
        self.thread.start()
        self.add_steady_timer(DISCOVERY_PERIOD_S, self._discover)
        self._discover()

    def _discover(self) -> None:
        if self.failure:
            raise InputError(
                f"cannot write the bag {self.params.bag}: {self.failure}; the messages written so far are in "
                f"{self.writer.incomplete_path}"
            )
        types = dict(self.get_topic_names_and_types())
        for topic in [t for t in self.waiting_topics if t in types]:
            if not self.count_publishers(topic):
                continue
            self.waiting_topics.remove(topic)
            if (message_class := self._find_class(types[topic][0])) is None:
                self.get_logger().warning(
                    f"{topic} is not recorded: {types[topic][0]} is unknown or not installed on this machine"
                )
                continue
            self.class_by_topic[topic] = message_class
            self._subscribe(topic)
            subscription = self.subscription_by_topic.get(topic)
            is_latched = subscription is not None and subscription.qos_profile.durability == LATCHED
            self.queue.put(("topic", topic, types[topic][0], LATCHED_QOS if is_latched else SENSOR_QOS))
        for topic in self.class_by_topic:
            if topic in self.incompatible or self._find_output(topic) is not self.link_by_topic.get(topic, (None,))[0]:
                self._unsubscribe(topic)
                self._subscribe(topic)
        missing_count = self.diagnostics.counts["lost"] + self.diagnostics.counts["dropped"]
        if missing_count > self.reported_count:
            self.reported_count = missing_count
            self.diagnostics.report(
                WARN,
                f"{self.diagnostics.counts['lost']} messages were lost in transit and "
                f"{self.diagnostics.counts['dropped']} dropped because the disk is too slow; "
                "record fewer topics or use a faster disk",
            )
        elif self.waiting_topics:
            self.diagnostics.report(WARN, f"waiting for {', '.join(self.waiting_topics)}", expected=True)
        else:
            self.diagnostics.report(OK, "recording")

    @staticmethod
    def _find_class(type_name: str) -> type | None:
        """Return the class of a message type; None if it cannot be received or written."""
        if type_name not in load_typestore().fielddefs:
            return None
        try:
            return load_message_class(type_name)
        except (ModuleNotFoundError, AttributeError):
            return None

    def _find_output(self, topic: str) -> Output | None:
        """Return the output of this process to link to, or None; latched messages arrive through DDS."""
        output = find_only_output(self, self.links, topic)
        return None if output is None or output.always_publishes else output

    def _subscribe(self, topic: str) -> None:
        """Link to an output of this process, or subscribe with a QoS compatible with all publishers."""
        receive = partial(self._enqueue, topic)
        if self.links is not None and (output := self._find_output(topic)) is not None:
            self.link_by_topic[topic] = output, receive
            self.links.connect(output, receive)
            return
        profiles = [info.qos_profile for info in self.get_publishers_info_by_topic(topic)]
        qos = QoSProfile(
            depth=DEPTH,
            reliability=(
                ReliabilityPolicy.RELIABLE
                if all(q.reliability == ReliabilityPolicy.RELIABLE for q in profiles)
                else ReliabilityPolicy.BEST_EFFORT
            ),
            durability=(LATCHED if all(q.durability == LATCHED for q in profiles) else DurabilityPolicy.VOLATILE),
        )
        on_message: Any = receive  # rclpy's type annotation lacks functools.partial
        self.subscription_by_topic[topic] = self.create_subscription(
            self.class_by_topic[topic],
            topic,
            on_message,
            qos,
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(
                message_lost=self.diagnostics.count_lost, incompatible_qos=lambda _: self.incompatible.add(topic)
            ),
        )

    def _unsubscribe(self, topic: str) -> None:
        self.incompatible.discard(topic)
        if (subscription := self.subscription_by_topic.pop(topic, None)) is not None:
            self.destroy_subscription(subscription)
        if self.links is not None and (link := self.link_by_topic.pop(topic, None)) is not None:
            self.links.disconnect(*link)

    def _enqueue(self, topic: str, message: Any, _: Any = None) -> None:
        """Queue a message for the writing thread. For links, the threads of the publishers call this."""
        size = len(message if isinstance(message, bytes) else getattr(message, "data", b""))
        with self.lock:
            waiting_bytes = self.queued_bytes - self.written_bytes
            if waiting_bytes and waiting_bytes + size > MAX_QUEUED_BYTES:
                self.diagnostics.counts["dropped"] += 1
                return
            self.diagnostics.counts["frames"] += 1
            self.queued_bytes += size
        self.queue.put(("message", topic, self.get_clock().now().nanoseconds, message, size))

    def _write(self) -> None:
        if sys.platform == "linux":  # elsewhere the priority belongs to the process instead of this thread
            os.setpriority(os.PRIO_PROCESS, 0, min(os.getpriority(os.PRIO_PROCESS, 0) + WRITER_NICENESS, 19))
        try:
            while (item := self.queue.get()) is not None:
                action, topic, *rest = item
                if action == "topic":
                    self.writer.add_topic(topic, *rest)
                else:
                    stamp, message, size = rest
                    self.writer.write(topic, stamp, to_cdr(message))
                    self.written_bytes += size
        except Exception as error:  # such as a full disk; the timer ends the node
            self.failure = error

    def close(self) -> None:
        self.queue.put(None)
        self.thread.join()
        try:
            self.writer.__exit__(type(self.failure) if self.failure else None, self.failure, None)
        except (InputError, OSError) as error:  # the partial file is kept
            self.get_logger().error(f"{self.writer.incomplete_path} is incomplete: {error}")
