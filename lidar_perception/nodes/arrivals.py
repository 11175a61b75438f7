"""Counts of received, dropped and lost clouds, and their rate."""

from __future__ import annotations

from collections import deque

import numpy as np

DEPTH = 5
WINDOW = 100  # number of sent clouds over which loss and drop rates are computed
RATE_SAMPLES = 20  # number of intervals whose median is the expected interval
RATE_INTERVALS = 10  # number of intervals whose mean gives the current rate


class Arrivals:
    """Count received, dropped and lost clouds (sent = received + dropped + lost).

    Publishers number their messages (publication_sequence_number). A gap counts as lost in transit
    or, if the queue was full, as dropped from the queue.
    """

    def __init__(self, depth: int = DEPTH):
        self.depth = depth
        self.sent = self.dropped = self.lost = 0
        self.sequence: int | None = None  # number of the last cloud
        self.window: deque[tuple[int, int, int]] = deque([(0, 0, 0)], WINDOW + 1)  # (sent, lost, dropped)
        self.stamps: deque[tuple[int, int]] = deque(maxlen=RATE_SAMPLES + 1)  # (sequence number, time of sending in ns)
        self.expected_rate: float | None = None  # rate of the first clouds, Hz; None before it is known

    def add(self, infos: list[dict], dropped: int, has_one_publisher: bool = True) -> None:
        """Count messages.

        Args:
            infos: rclpy's message infos of all messages that were in the queue, oldest first.
            dropped: number of these messages that are not processed.
            has_one_publisher: False with several publishers, whose numbers cannot be compared.
        """
        queue_was_full = len(infos) >= self.depth
        for i, info in enumerate(infos):
            number, gap = info["publication_sequence_number"], 0
            if has_one_publisher and number and self.sequence is not None and number > self.sequence:
                gap = number - self.sequence - 1
            self.sequence = (number or None) if has_one_publisher else None
            if queue_was_full and i == 0:
                self.dropped += gap
            else:
                self.lost += gap
            self.sent += 1 + gap
            self.stamps.append((self.sent, info["source_timestamp"]))
        self.dropped += dropped
        self.window.append((self.sent, self.lost, self.dropped))
        if self.expected_rate is None and len(self.stamps) > RATE_SAMPLES:
            intervals = np.diff(np.array(self.stamps, float), axis=0)
            period = np.median(intervals[:, 1] / intervals[:, 0])
            self.expected_rate = 1e9 / period if period > 0 else None

    def record_interruption(self, dropped: int) -> None:
        """Count the waiting clouds as dropped, and do not count the gap until the next cloud."""
        self.dropped += dropped
        self.sequence = None
        self.stamps.clear()
        self.reset_window()

    def reset_window(self) -> None:
        """Restart the window of count_recent() when the cause of earlier drops is gone."""
        self.window.clear()
        self.window.append((self.sent, self.lost, self.dropped))

    def count_recent(self) -> tuple[int, int, int]:
        """Return (sent, lost, dropped) of the last WINDOW sent clouds, or of more after a long gap."""
        end = self.window[-1]
        start = next((counts for counts in reversed(self.window) if end[0] - counts[0] >= WINDOW), self.window[0])
        sent, lost, dropped = (last - first for last, first in zip(end, start))
        return sent, lost, dropped

    def measure_rate(self) -> float | None:
        """Return the current rate of sent clouds in Hz, or None while too few have arrived."""
        if len(self.stamps) <= RATE_INTERVALS:
            return None
        (n0, t0), (n1, t1) = self.stamps[-1 - RATE_INTERVALS], self.stamps[-1]
        return 1e9 * (n1 - n0) / (t1 - t0) if t1 > t0 else None
