"""Flow control of a replay: the next cloud is sent once the previous ones have detections."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from time import monotonic
from typing import Any

from lidar_perception.nodes.interfaces import MARKERS, RELIABLE
from msg_utils.messages import load_message_class

MAX_CLOUDS = 1000  # maximum number of clouds without an answer, and of stored latencies
SHORT_TIMEOUT_S = 1.0  # timeout for a detection after an earlier one has timed out


class Pace:
    """Tracks the clouds that have no detections yet, and limits their number.

    Detections are the answer to the cloud with the same header.stamp. If an answer does not arrive
    within `timeout` seconds, or before that of a later cloud, it counts as missing and is no longer
    awaited, so that every replay ends.

    Args:
        node: the node that subscribes to the topics.
        topics: topics of detections.
        ahead: maximum number of clouds without an answer; 0: no limit, only measure latencies.
        timeout: maximum time to wait for an answer, in seconds.

    Attributes:
        latencies_ms: times from sending a cloud to its last answer.
        missing_answers: number of answers that have not arrived in time.
        held_s: total time that clouds have waited, in seconds.
    """

    def __init__(self, node: Any, topics: Sequence[str], ahead: int, timeout: float):
        self.ahead, self.timeout, self.patience = ahead, timeout, timeout
        self.unanswered_clouds: dict[bytes, set[str]] = {}  # stamp in CDR encoding -> missing topics, oldest first
        self.sent_times: dict[bytes, float] = {}  # stamp -> monotonic time of publication
        self.latencies_ms: deque[float] = deque(maxlen=MAX_CLOUDS)
        self.missing_answers, self.held_s = 0, 0.0
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
            self.unanswered_clouds[stamp], self.sent_times[stamp] = set(self.topics), monotonic()
            if len(self.unanswered_clouds) > MAX_CLOUDS:
                self._give_up()

    def add_answer(self, stamp: bytes, topic: str) -> None:
        """Register detections on a topic; earlier clouds without detections there are no longer awaited."""
        if stamp not in self.unanswered_clouds:
            return
        self.patience = self.timeout
        for cloud_stamp in list(self.unanswered_clouds):
            missing_topics = self.unanswered_clouds[cloud_stamp]
            self.missing_answers += topic in missing_topics and cloud_stamp != stamp
            missing_topics.discard(topic)
            if not missing_topics:
                del self.unanswered_clouds[cloud_stamp]
                sent_time = self.sent_times.pop(cloud_stamp)
                if cloud_stamp == stamp:
                    self.latencies_ms.append((monotonic() - sent_time) * 1e3)
            if cloud_stamp == stamp:
                return

    def _give_up(self) -> None:
        """Stop waiting for the answers to the oldest cloud, and count them as missing."""
        oldest_stamp = next(iter(self.unanswered_clouds))
        self.missing_answers += len(self.unanswered_clouds.pop(oldest_stamp))
        del self.sent_times[oldest_stamp]

    def wait_for_room(self, serve: Callable[[], Any], is_stopped: Callable[[], bool]) -> None:
        """Call serve() until another cloud may be sent, or until is_stopped()."""
        begin = monotonic()
        while self.ahead and len(self.unanswered_clouds) >= self.ahead and not is_stopped():
            if monotonic() - begin > self.patience:
                self._give_up()
                self.patience = min(self.patience, SHORT_TIMEOUT_S)
                break
            serve()
        self.held_s += monotonic() - begin

    def wait_for_answers(self, serve: Callable[[], Any], is_stopped: Callable[[], bool]) -> None:
        """Call serve() until all clouds have answers, or until is_stopped(). This time is not added to held_s."""
        held_s, self.ahead = self.held_s, min(self.ahead, 1)
        while self.ahead and self.unanswered_clouds and not is_stopped():
            self.wait_for_room(serve, is_stopped)
        self.held_s = held_s
