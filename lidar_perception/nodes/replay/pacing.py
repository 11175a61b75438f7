"""A replay that loses nothing: the next cloud is sent when the graph has answered those before."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import monotonic
from typing import Any

from lidar_perception.nodes.runtime import MARKERS, RELIABLE
from msg_utils.messages import message_class

IMPATIENT = 1.0  # seconds for an answer, once one has not come in time


class Pace:
    """Which clouds have no answer yet on each of some topics of detections.

    An answer has the cloud's header.stamp. Whoever sends asks room() before each cloud. What is
    not answered in `timeout` seconds, or after a later cloud, is counted as unanswered and waited
    for no longer, so a replay ends whatever the graph does.
    """

    def __init__(self, node: Any, topics: Sequence[str], ahead: int, timeout: float):
        self.ahead, self.timeout, self.patience = ahead, timeout, timeout
        self.waiting: dict[bytes, set[str]] = {}  # stamp as in CDR -> topics; oldest first
        self.unanswered, self.held = 0, 0.0
        self.topics = frozenset(topics)
        for topic in topics:
            node.create_subscription(message_class(MARKERS), topic,
                                     lambda data, t=topic: self.answered(data[8:16], t), RELIABLE,
                                     raw=True)  # CDR: encapsulation, count, the first one's stamp

    def sent(self, cloud: bytes) -> None:
        """A cloud, as CDR."""
        if self.topics:
            self.waiting[bytes(cloud[4:12])] = set(self.topics)

    def answered(self, stamp: bytes, topic: str) -> None:
        """An answer on a topic: to this cloud; to those before it none will come."""
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

    def room(self, serve: Callable[[], Any], stopped: Callable[[], bool]) -> None:
        """Call serve() until another cloud may be sent."""
        begin = monotonic()
        while len(self.waiting) >= self.ahead and not stopped():
            if monotonic() - begin > self.patience:
                self.unanswered += len(self.waiting.pop(next(iter(self.waiting))))
                self.patience = min(self.patience, IMPATIENT)
                break
            serve()
        self.held += monotonic() - begin
