"""Interface of the storage files of bags: MCAP, SQLite and ROS 1.

rosbags' reader of ROS 2 bags is not used: it trusts metadata.yaml and finds messages by the text of
their QoS (rosbags/rosbag2/reader.py), and refuses MCAP files that it does not expect
(rosbags/rosbag2/storage_mcap.py).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from heapq import heappop, heappush, heapreplace
from typing import Any, NamedTuple, Protocol

START, END = -2**63, 2**63 - 1  # before and after all times in nanoseconds
Message = tuple[Any, int, bytes]  # its topic, time of recording in nanoseconds, data
Stream = Iterator[Message]  # in order of time


class Topic(NamedTuple):
    """A topic of one file; a file may have several of one name.

    id: of its messages. type: "pkg/msg/Name", or "" where the file does not say it. encoding: "cdr"
    where its messages can be read. qos: the offered profiles, as YAML text or parsed.
    messages: number of its messages.
    """

    id: int
    name: str
    type: str
    encoding: str
    qos: Any
    messages: int


class StorageFile(Protocol):
    """A file open for reading. times: of the first and the last message in nanoseconds, None
    without messages. Everything is taken from the file itself, never from metadata.yaml."""

    topics: list[Topic]
    times: tuple[int, int] | None

    def messages(self, ids: Collection[int], start: int, stop: int) -> Stream:
        """Yield the messages of topics, start <= time < stop, in order of time."""

    def close(self) -> None:
        """Close the file."""


def in_time_order(sources: Iterable[tuple[int, Callable[[], Stream]]]) -> Stream:
    """Merge streams, each given with the time from which on it has messages. A stream is opened
    when that time has come, and closed by its end: few are open at a time."""
    open_streams: list[tuple[int, int, Message, Stream]] = []
    for number, (start, begin) in enumerate([*sorted(sources, key=lambda source: source[0]),
                                             (END, lambda: iter(()))]):
        while open_streams and open_streams[0][0] < start:
            _, which, message, stream = open_streams[0]
            yield message
            if (following := next(stream, None)) is None:
                heappop(open_streams)
            else:
                heapreplace(open_streams, (following[1], which, following, stream))
        stream = begin()
        if (first := next(stream, None)) is not None:
            heappush(open_streams, (first[1], number, first, stream))
