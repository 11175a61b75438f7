"""Interface of the storage files of bags: MCAP, SQLite and ROS 1.

The reader of rosbags is not used: it trusts metadata.yaml, finds messages by the text of their QoS
(rosbags/rosbag2/reader.py), and rejects unusual MCAP files (rosbags/rosbag2/storage_mcap.py).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from heapq import heappop, heappush, heapreplace
from typing import Any, NamedTuple, Protocol

START, END = -(2**63), 2**63 - 1  # limits before and after all times, in ns
Message = tuple[Any, int, bytes]  # (topic id, log time in ns, data)
Stream = Iterator[Message]  # sorted by time


class Topic(NamedTuple):
    """A topic of a file; a file may have several topics with the same name.

    Attributes:
        id: topic id of its messages.
        type: "pkg/msg/Name", or "" if the file does not state it.
        encoding: "cdr" if its messages can be read.
        qos: offered profiles, as YAML text or parsed.
        messages: number of messages.
    """

    id: int
    name: str
    type: str
    encoding: str
    qos: Any
    messages: int


class StorageFile(Protocol):
    """A storage file open for reading. Its content never depends on metadata.yaml.

    Attributes:
        times: times of the first and last message in ns; None without messages.
    """

    topics: list[Topic]
    times: tuple[int, int] | None

    def read_messages(self, ids: Collection[int], start: int, stop: int) -> Stream:
        """Yield the messages of topics with start <= time < stop, in order of time."""

    def close(self) -> None:
        """Close the file."""


def merge_streams(sources: Iterable[tuple[int, Callable[[], Stream]]]) -> Stream:
    """Merge streams in order of time.

    Each stream is opened at its start time, so that few are open at the same time.

    Args:
        sources: start time of each stream, and the function that opens it.
    """
    open_streams: list[tuple[int, int, Message, Stream]] = []
    for start_number, (start, open_stream) in enumerate(
        [*sorted(sources, key=lambda source: source[0]), (END, lambda: iter(()))]
    ):
        while open_streams and open_streams[0][0] < start:
            _, stream_number, message, stream = open_streams[0]
            yield message
            if (next_message := next(stream, None)) is None:
                heappop(open_streams)
            else:
                heapreplace(open_streams, (next_message[1], stream_number, next_message, stream))
        stream = open_stream()
        if (first := next(stream, None)) is not None:
            heappush(open_streams, (first[1], start_number, first, stream))
