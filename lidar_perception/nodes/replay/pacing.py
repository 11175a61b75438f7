"""Flow control of a replay: the next cloud waits for the detections of the clouds before it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import monotonic
from typing import Any

from lidar_perception.nodes.runtime import MARKERS, RELIABLE
from msg_utils.messages import load_message_class

SHORT_TIMEOUT_S = 1.0  # for a detection, after one has timed out


class Pace:
    """Clouds that have no detections yet on some topics.

    Detections answer a cloud with their header.stamp. A cloud without an answer within `timeout`
    seconds, or before the answer to a later cloud, counts as unanswered and is no longer awaited,
    so that every replay ends.

    Args:
        node: the node that subscribes to the topics.
        topics: topics of detections.
        ahead: number of clouds that may be unanswered at a time.
        timeout: seconds.
    """

    def __init__(self, node: Any, topics: Sequence[str], ahead: int, timeout: float):
        self.ahead, self.timeout, self.patience = ahead, timeout, timeout
        self.waiting: dict[bytes, set[str]] = {}  # stamp as in CDR -> missing topics; oldest first
        self.unanswered, self.held = 0, 0.0
        self.topics = frozenset(topics)
        for topic in topics:
            node.create_subscription(load_message_class(MARKERS), topic,
                                     lambda data, t=topic: self.add_answer(data[8:16], t), RELIABLE,
                                     raw=True)  # CDR: 8 bytes, then the first marker's stamp

    def add_cloud(self, cloud: bytes) -> None:
        """Register a cloud, as CDR, that is sent now."""
        if self.topics:
            self.waiting[bytes(cloud[4:12])] = set(self.topics)

    def add_answer(self, stamp: bytes, topic: str) -> None:
        """Register detections on a topic; earlier clouds without any count as unanswered."""
        if stamp not in self.waiting:
            return
        self.patience = self.timeout
        for earlier in list(self.waiting):
            left = self.waiting[earlier]
            missed = topic in left and earlier != stamp
            left.discard(topic)
            self.unanswered += missed
            if not left:
                del self.waiting[earlier]
            if earlier == stamp:
                return

    def wait_for_room(self, serve: Callable[[], Any], is_stopped: Callable[[], bool]) -> None:
        """Call serve() until another cloud may be sent, or is_stopped()."""
        begin = monotonic()
        while len(self.waiting) >= self.ahead and not is_stopped():
            if monotonic() - begin > self.patience:
                self.unanswered += len(self.waiting.pop(next(iter(self.waiting))))
                self.patience = min(self.patience, SHORT_TIMEOUT_S)
                break
            serve()
        self.held += monotonic() - begin
