"""ROS node of `view --live`, which receives the messages of a running graph."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from time import monotonic
from typing import Any

from lidar_perception.nodes.external_node import ExternalNode
from lidar_perception.nodes.interfaces import CLOUD, MARKERS
from lidar_perception.nodes.reception import Reception
from lidar_perception.nodes.subscriptions import decode_message
from lidar_perception.nodes.transforms import NO_TF, STATIC_QOS, TF_QOS, has_tf
from lidar_perception.params import ReceptionParams
from lidar_perception.runs.files import shorten_error
from lidar_perception.types import InputError
from lidar_perception.wire.topics import TF, TF_STATIC
from lidar_perception.wire.transforms import TF_MESSAGE, add_transforms
from lidar_studio.live_graph import LiveGraph
from lidar_studio.live_topics import select_box_topics, select_cloud_topic
from msg_utils.detections import from_detection_array
from msg_utils.markers import from_marker_array
from msg_utils.messages import load_message_class

TOPIC_UPDATE_PERIOD_S = 1.0
STOP_TIMEOUT_S = 5.0  # maximum time to wait for the thread to end
RECEPTION = ReceptionParams(queue=5)
SHOWN_PROBLEMS = "publishers", "silent", "stale", "lost", "dropped"  # kinds of Reception.problems


class LiveView(ExternalNode):
    """Node that subscribes to the topics of a running graph while run() is executed.

    Args:
        clouds: Topic of the clouds, or "" to select one with select_cloud_topic().
        boxes: Topics of detections, or () to select them with select_box_topics().
    """

    def __init__(
        self,
        live: LiveGraph,
        domain: int | None = None,
        namespace: str = "",
        clouds: str = "",
        boxes: Sequence[str] = (),
    ) -> None:
        super().__init__(domain, f"view_{os.getpid()}")
        self.live, self.namespace = live, namespace
        self.requested_clouds, self.requested_boxes = clouds, tuple(boxes)
        self.receptions: dict[str, Reception] = {}
        self.decode_errors: dict[str, str] = {}  # topic -> error in its last message
        self.clouds, self.problem, self._last_topic_update = "", "", -math.inf
        if has_tf():
            for topic, qos in ((TF, TF_QOS), (TF_STATIC, STATIC_QOS)):
                self.node.create_subscription(
                    load_message_class(TF_MESSAGE),
                    topic,
                    self._make_handler(
                        topic, TF_MESSAGE, partial(add_transforms, live.tree, static=topic == TF_STATIC)
                    ),
                    qos,
                    raw=True,
                )

    def run(self, stop: threading.Event) -> None:
        """Spin until `stop` is set. Exceptions are shown on the page and re-raised."""
        try:
            self.spin_until(stop.is_set, math.inf, self._step)
        except Exception as error:  # show it on the page, because nobody joins this thread
            self.live.problems = [
                f"reception has stopped: {type(error).__name__}: {shorten_error(error)}; restart lidar-perception view"
            ]
            self.live.update()
            raise

    def _step(self) -> None:
        if monotonic() - self._last_topic_update >= TOPIC_UPDATE_PERIOD_S:
            self._last_topic_update = monotonic()
            self.update_topics()
        self.live.update()

    def update_topics(self) -> None:
        """Subscribe to the topics to show, and unsubscribe from all others.

        A cloud topic that has lost its publisher is kept until another cloud topic appears.
        """
        types = {
            topic: kinds[0]
            for topic, kinds in self.node.get_topic_names_and_types()
            if len(kinds) == 1 and self.node.count_publishers(topic)
        }
        self.problem = ""
        try:
            cloud_topic = select_cloud_topic(types, self.namespace, self.requested_clouds)
        except InputError as error:
            cloud_topic, self.problem = self.clouds, str(error)
        if cloud_topic != self.clouds:
            self._forget([self.clouds] if self.clouds else [])
            self.clouds = cloud_topic
            self._subscribe(cloud_topic, CLOUD, lambda m: self.live.add_cloud(m))
        box_topics = select_box_topics(types, cloud_topic, self.namespace, self.requested_boxes) if cloud_topic else {}
        for topic in box_topics.keys() - self.receptions.keys():
            self.live.expect_topic(topic, box_topics[topic])
            self._subscribe(topic, types[topic], self._make_box_handler(topic, types[topic]))
        self._forget(self.receptions.keys() - box_topics.keys() - {self.clouds})
        for reception in self.receptions.values():
            reception.adapt()
        self._update_status()

    def _forget(self, topics: Iterable[str]) -> None:
        for topic in list(topics):
            self.receptions.pop(topic).close()
            self.decode_errors.pop(topic, None)
            self.live.forget_topic(topic)

    def _subscribe(self, topic: str, message_type: str, callback: Callable[[Any], None]) -> None:
        handle = self._make_handler(topic, message_type, callback)
        reception = self.receptions[topic] = Reception(
            self.node,
            load_message_class(message_type),
            topic,
            lambda data, patient: handle(data),
            lambda: RECEPTION,
            "cloud" if message_type == CLOUD else "array",
        )
        reception.open()

    def _make_handler(self, topic: str, message_type: str, callback: Callable[[Any], None]) -> Callable[[bytes], None]:
        def handle(data: bytes) -> None:
            try:
                callback(decode_message(data, message_type))
                self.decode_errors.pop(topic, None)
            except Exception as error:  # other nodes may send invalid messages
                self.decode_errors[topic] = f"{topic}: {shorten_error(error)}"

        return handle

    def _make_box_handler(self, topic: str, message_type: str) -> Callable[[Any], None]:
        if message_type == MARKERS:
            return lambda m: self.live.add_boxes(topic, from_marker_array(m), m)
        return lambda m: self.live.add_boxes(topic, from_detection_array(m), None)

    def _update_status(self) -> None:
        clouds = self.receptions.get(self.clouds)
        lines = [self.problem] if self.problem else []
        if clouds is not None:
            self.live.statistics = {"topic": self.clouds, **clouds.values()}
            if not self.problem:
                lines += [text for kind, _, text in clouds.problems() if kind in SHOWN_PROBLEMS]
                if clouds.last_time is None:
                    lines.append(f"no cloud has arrived on {self.clouds} yet")
        for topic, reception in self.receptions.items():
            lost_count = reception.arrivals.lost + reception.arrivals.dropped
            if topic != self.clouds and lost_count:
                lines.append(f"{lost_count} of {reception.arrivals.sent} arrays on {topic} were lost")
        if any(box_topic.tf_problem for box_topic in self.live.topics.values()) and not has_tf():
            lines.append(NO_TF)
        self.live.problems = [*lines, *self.decode_errors.values()]


@contextmanager
def run_live_view(live: LiveGraph, *arguments: Any) -> Iterator[None]:
    """Create a LiveView with these arguments, and run it in a thread while the context is open."""
    with LiveView(live, *arguments) as view:
        stop = threading.Event()
        thread = threading.Thread(target=view.run, args=(stop,), daemon=True)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join(STOP_TIMEOUT_S)
