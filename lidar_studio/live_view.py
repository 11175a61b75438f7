"""The node behind the page of `view --live`: listens to a running graph, hands on what comes."""

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
from lidar_perception.nodes.reception import Reception
from lidar_perception.nodes.runtime import CLOUD, MARKERS, decode_message
from lidar_perception.nodes.transforms import NO_TF, STATIC_QOS, TF_QOS, has_tf
from lidar_perception.params import ReceptionParams
from lidar_perception.runs.files import shorten_error
from lidar_perception.types import InputError
from lidar_perception.wire.topics import TF, TF_STATIC
from lidar_perception.wire.transforms import TF_MESSAGE, add_transforms
from lidar_studio.live import Live
from lidar_studio.live_topics import box_topics, clouds_topic
from msg_utils.detections import from_detection_array
from msg_utils.markers import from_marker_array
from msg_utils.messages import load_message_class

LOOK = 1.0    # seconds between looks at what there is
ENDING = 5.0  # seconds for the message in hand
RECEIVED = ReceptionParams(queue=5)
SAID = "publishers", "silent", "stale", "lost", "dropped"  # of what a Reception finds wrong


class LiveView(ExternalNode):
    """Listens from its making on, while run() is called. clouds, boxes: topics that are wanted; ""
    and none: those that live_topics finds."""

    def __init__(self, live: Live, domain: int | None = None, namespace: str = "",
                 clouds: str = "", boxes: Sequence[str] = ()) -> None:
        super().__init__(domain, f"view_{os.getpid()}")
        self.live, self.namespace, self.wanted = live, namespace, (clouds, tuple(boxes))
        self.receptions: dict[str, Reception] = {}
        self.broken: dict[str, str] = {}  # topic -> what was wrong with its last message
        self.clouds, self.problem, self._looked = "", "", -math.inf
        if has_tf():
            for topic, qos in ((TF, TF_QOS), (TF_STATIC, STATIC_QOS)):
                self.node.create_subscription(
                    load_message_class(TF_MESSAGE), topic, self._taking(
                        topic, TF_MESSAGE, partial(add_transforms, live.tree,
                                                   static=topic == TF_STATIC)), qos, raw=True)

    def run(self, stop: threading.Event) -> None:
        """Listen until it is told to stop; what goes wrong in that is said on the page."""
        try:
            self.spin_until(stop.is_set, math.inf, self._each)
        except Exception as error:  # of a thread nobody waits for
            self.live.lines = [f"nothing is received any more: {type(error).__name__}: "
                               f"{shorten_error(error)}; start again"]
            self.live.tick()
            raise

    def _each(self) -> None:
        if monotonic() - self._looked >= LOOK:
            self._looked = monotonic()
            self.look()
        self.live.tick()

    def look(self) -> None:
        """See what is published, and listen to what is wanted of it. Clouds that are not published
        for the moment are waited for, until there are others."""
        types = {topic: kinds[0] for topic, kinds in self.node.get_topic_names_and_types()
                 if len(kinds) == 1 and self.node.count_publishers(topic)}
        self.problem = ""
        try:
            chosen = clouds_topic(types, self.namespace, self.wanted[0])
        except InputError as error:
            chosen, self.problem = self.clouds, str(error)
        if chosen != self.clouds:
            self._forget([self.clouds] if self.clouds else [])
            self.clouds = chosen
            self._open(chosen, CLOUD, lambda m: self.live.cloud(m))
        found = box_topics(types, chosen, self.namespace, self.wanted[1]) if chosen else {}
        for topic in found.keys() - self.receptions.keys():
            self.live.hear(topic, found[topic])
            self._open(topic, types[topic], self._boxes(topic, types[topic]))
        self._forget(self.receptions.keys() - found.keys() - {self.clouds})
        for reception in self.receptions.values():
            reception.adapt()
        self._say()

    def _forget(self, topics: Iterable[str]) -> None:
        for topic in list(topics):
            self.receptions.pop(topic).close()
            self.broken.pop(topic, None)
            self.live.forget(topic)

    def _open(self, topic: str, kind: str, take: Callable[[Any], None]) -> None:
        taking = self._taking(topic, kind, take)
        reception = self.receptions[topic] = Reception(
            self.node, load_message_class(kind), topic, lambda data, patient: taking(data),
            lambda: RECEIVED, "cloud" if kind == CLOUD else "array")
        reception.open()

    def _taking(self, topic: str, kind: str,
                take: Callable[[Any], None]) -> Callable[[bytes], None]:
        def taking(data: bytes) -> None:
            try:
                take(decode_message(data, kind))
                self.broken.pop(topic, None)
            except Exception as error:  # of whatever anybody sends: it is said, and the next taken
                self.broken[topic] = f"{topic}: {shorten_error(error)}"
        return taking

    def _boxes(self, topic: str, kind: str) -> Callable[[Any], None]:
        if kind == MARKERS:
            return lambda m: self.live.boxes(topic, from_marker_array(m), m)
        return lambda m: self.live.boxes(topic, from_detection_array(m), None)

    def _say(self) -> None:
        clouds = self.receptions.get(self.clouds)
        lines = [self.problem] if self.problem else []
        if clouds is not None:
            self.live.values = {"topic": self.clouds, **clouds.values()}
            if not self.problem:
                lines += [text for kind, _, text in clouds.problems() if kind in SAID]
                if clouds.last_time is None:
                    lines.append(f"no cloud has come on {self.clouds} yet")
        for topic, reception in self.receptions.items():
            lost = reception.arrivals.lost + reception.arrivals.dropped
            if topic != self.clouds and lost:
                lines.append(f"{lost} of {reception.arrivals.sent} arrays on {topic} were lost")
        if any(heard.elsewhere for heard in self.live.topics.values()) and not has_tf():
            lines.append(NO_TF)
        self.live.lines = [*lines, *self.broken.values()]


@contextmanager
def listening(live: Live, *arguments: Any) -> Iterator[None]:
    """A LiveView in a thread of its own, for as long as the block lasts; takes its arguments."""
    with LiveView(live, *arguments) as view:
        stop = threading.Event()
        thread = threading.Thread(target=view.run, args=(stop,), daemon=True)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join(ENDING)
