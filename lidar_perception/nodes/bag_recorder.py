"""Records topics to an MCAP bag, where ros2 bag is not installed."""

from __future__ import annotations

import queue
import threading
from typing import Any

from rclpy.qos import QoSProfile

from lidar_perception.datasets.bag import LATCHED_QOS, SENSOR_QOS, BagWriter
from lidar_perception.nodes.runtime import LATCHED, OK, RELIABLE, SENSOR_DATA, WARN, LidarNode
from lidar_perception.params import RecorderParams
from lidar_perception.types import InputError
from msg_utils.messages import message_class

DISCOVERY_PERIOD = 0.2  # seconds between looks for the type of a topic that is not there yet


class BagRecorder(LidarNode):
    """Raw bytes from DDS to the file, compressed in a thread of its own. The bag is complete when
    the node has ended."""

    def __init__(self, **options: Any):
        super().__init__("bag_recorder", RecorderParams(), **options)
        if not self.params.bag or not self.params.topics:
            raise InputError("parameters 'bag' and 'topics' must name the bag and its topics")
        self.writer = BagWriter(self.params.bag)
        self.writer.__enter__()
        self.waiting = list(self.params.topics)
        self.queue: queue.Queue = queue.Queue()
        self.thread = threading.Thread(target=self._write)
        self.thread.start()
        self.create_timer(DISCOVERY_PERIOD, self._discover)
        self._discover()

    def _discover(self) -> None:
        types = dict(self.get_topic_names_and_types())
        for topic in [t for t in self.waiting if t in types]:
            offered = [i.qos_profile for i in self.get_publishers_info_by_topic(topic)]
            if not offered:
                continue
            self.waiting.remove(topic)
            latched = all(q.durability == LATCHED.durability for q in offered)
            reliable = all(q.reliability == RELIABLE.reliability for q in offered)
            self.queue.put(("topic", topic, types[topic][0],
                            LATCHED_QOS if latched else SENSOR_QOS))
            self._subscribe(topic, message_class(types[topic][0]),
                            LATCHED if latched else RELIABLE if reliable else SENSOR_DATA)
        self.report(*((WARN, f"waiting for {', '.join(self.waiting)}") if self.waiting
                      else (OK, "recording")))

    def _subscribe(self, topic: str, kind: type, qos: QoSProfile) -> None:
        def received(data: bytes) -> None:
            self.counts["frames"] += 1
            self.queue.put(("message", topic, self.get_clock().now().nanoseconds, data))

        self.create_subscription(kind, topic, received, qos, raw=True)

    def _write(self) -> None:
        while (item := self.queue.get()) is not None:
            what, topic, *rest = item
            if what == "topic":
                self.writer.add_topic(topic, *rest)
            else:
                self.writer.write(topic, *rest)

    def close(self) -> None:
        self.queue.put(None)
        self.thread.join()
        self.writer.__exit__(None, None, None)
