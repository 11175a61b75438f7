"""Flow control of a replay: the next cloud is sent once the previous ones have detections."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from time import monotonic
from typing import Any

from lidar_perception.nodes.interfaces import MARKERS, RELIABLE
from msg_utils.messages import load_message_class

MAX_WAITING = 1000  # maximum number of clouds that wait for answers, and of stored latencies
SHORT_TIMEOUT_S = 1.0  # timeout for a detection after an earlier one has timed out


class Pace:
    """Tracks the clouds that have no detections yet, and limits their number.

    Detections answer the cloud with the same header.stamp. A cloud without an answer within
    `timeout` seconds, or before the answer to a later cloud, counts as unanswered and is no longer
    awaited, so that every replay ends.

    Args:
        node: the node that subscribes to the topics.
        topics: topics of detections.
        ahead: maximum number of clouds without an answer; 0: no limit, only measure latencies.
        timeout: maximum time to wait for an answer, in seconds.

    Attributes:
        latencies_ms: times from sending a cloud to its last answer.
        unanswered: number of missing answers.
        held: total time that clouds have waited, in seconds.
    """

    def __init__(self, node: Any, topics: Sequence[str], ahead: int, timeout: float):
        self.ahead, self.timeout, self.patience = ahead, timeout, timeout
        self.waiting: dict[bytes, set[str]] = {}  # stamp in CDR encoding -> missing topics, oldest first
        self.sent: dict[bytes, float] = {}  # stamp -> monotonic time of publication
        self.latencies_ms: deque[float] = deque(maxlen=MAX_WAITING)
        self.unanswered, self.held = 0, 0.0
        self.topics = frozenset(topics)
        for topic in topics:
            node.create_subscription(
                load_message_class(MARKERS),
                topic,
                lambda data, t=topic: self.add_answer(data[8:16], t),
                RELIABLE,
                raw=True,
            )  # CDR layout: 8 bytes, then the first marker's stamp

    def add_cloud(self, cloud: bytes) -> None:
        """Register a cloud (CDR) that is being sent."""
        if self.topics:
            stamp = bytes(cloud[4:12])
            self.waiting[stamp], self.sent[stamp] = set(self.topics), monotonic()
            if len(self.waiting) > MAX_WAITING:
                self._give_up()

    def add_answer(self, stamp: bytes, topic: str) -> None:
        """Register detections on a topic. Earlier clouds without an answer there count as unanswered."""
        if stamp not in self.waiting:
            return
        self.patience = self.timeout
        for cloud_stamp in list(self.waiting):
            missing_topics = self.waiting[cloud_stamp]
            self.unanswered += topic in missing_topics and cloud_stamp != stamp
            missing_topics.discard(topic)
            if not missing_topics:
                del self.waiting[cloud_stamp]
                sent = self.sent.pop(cloud_stamp)
                if cloud_stamp == stamp:
                    self.latencies_ms.append((monotonic() - sent) * 1e3)
            if cloud_stamp == stamp:
                return

    def _give_up(self) -> None:
        """Count the missing answers to the oldest cloud as unanswered."""
        oldest = next(iter(self.waiting))
        self.unanswered += len(self.waiting.pop(oldest))
        del self.sent[oldest]

    def wait_for_room(self, serve: Callable[[], Any], is_stopped: Callable[[], bool]) -> None:
        """Call serve() until another cloud may be sent, or until is_stopped()."""
        begin = monotonic()
        while self.ahead and len(self.waiting) >= self.ahead and not is_stopped():
            if monotonic() - begin > self.patience:
                self._give_up()
                self.patience = min(self.patience, SHORT_TIMEOUT_S)
                break
            serve()
        self.held += monotonic() - begin

    def wait_for_answers(self, serve: Callable[[], Any], is_stopped: Callable[[], bool]) -> None:
        """Call serve() until all clouds are answered, or until is_stopped(); not counted as held."""
        held, self.ahead = self.held, min(self.ahead, 1)
        while self.ahead and self.waiting and not is_stopped():
            self.wait_for_room(serve, is_stopped)
        self.held = held
