"""MCAP files without chunks, as rosbag2 writes them with its preset `fastwrite`. Nothing in them
says where a message is, so that rosbags reads the whole file for each one that is asked for."""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator
from functools import cached_property

import numpy as np
from rosbags.interfaces import Connection
from rosbags.rosbag2.storage_mcap import McapReader

from lidar_perception.data.mcap_index import MESSAGE, RECORD, records

HEAD = struct.Struct("<HIQQ")  # of a message: channel, number, time of the recorder, of the sender
PLACE = np.dtype([("time", np.int64), ("channel", np.uint16), ("at", np.int64),
                  ("bytes", np.int64)])


class Unchunked:
    """The messages of an open file, in order of time whatever theirs in the file is."""

    def __init__(self, part: McapReader):
        assert part.bio is not None  # as of what is open
        self.file, self.end = part.bio.fileno(), part.data_end

    @cached_property
    def places(self) -> np.ndarray:
        """(M,) PLACE, ascending times. Looks at 64 bytes of each record, once."""
        found = []
        for at, kind, length, head in records(self.file, self.end):
            if kind == MESSAGE:
                channel, _, time, _ = HEAD.unpack_from(head, RECORD.size)
                found.append((time, channel, at + RECORD.size + HEAD.size, length - HEAD.size))
        places = np.array(found, PLACE)
        return places[np.argsort(places["time"], kind="stable")]

    def messages(self, connections: Collection[Connection], start: int | None = None,
                 stop: int | None = None) -> Iterator[tuple[Connection, int, bytes]]:
        """As rosbags has it: (connection, time, data), start <= time < stop, in order of time."""
        wanted = {connection.id: connection for connection in connections}
        times = self.places["time"]
        begin = 0 if start is None else np.searchsorted(times, start)
        end = len(times) if stop is None else np.searchsorted(times, stop)
        for time, channel, at, size in self.places[begin:end].tolist():
            if channel in wanted:
                yield wanted[channel], time, os.pread(self.file, size, at)
