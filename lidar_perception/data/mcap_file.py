"""MCAP files by any writer: with or without chunks, indexes, statistics and repeated channels.

Channels, counts and places of messages come from the data section. The summary at the end is
compared with it, so that damage in either is found. Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from functools import partial
from io import BytesIO
from operator import itemgetter
from pathlib import Path
from zlib import crc32

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.records import Channel, Schema

from lidar_perception.data.storage import END, Stream, Topic, in_time_order
from lidar_perception.wire.compression import MAX_BYTES, decompress

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = 1, 2, 3, 4, 5, 6
MESSAGE_INDEX, CHUNK_INDEX, DATA_END = 7, 8, 15
HEAD_BYTES = 64  # of a record, looked at
RECORD = struct.Struct("<BQ")  # of each: its kind, and how many bytes follow
FOOTER_BYTES = RECORD.size + 20
NO_INDEX = (RECORD.pack(DATA_END, 4) + bytes(4) + RECORD.pack(FOOTER, 20) + bytes(20)
            + MAGIC)  # the end of a file that has none
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, number, time of the recorder, of the sender
ENTRY_BYTES = 16  # of a message index, for each message
PLACE = np.dtype([("time", np.int64), ("channel", np.uint16), ("at", np.int64),
                  ("bytes", np.int64)])


@dataclass
class Chunk:
    """place: what a chunk index says of it, see _indexed. start, end: times in its header. at: of
    its compressed data in the file. counts: number of messages by channel."""

    place: tuple[int, int, int, int, bytes, int, int]
    start: int
    end: int
    at: int
    crc: int
    counts: dict[int, int] = field(default_factory=dict)


class McapFile:
    """An MCAP file open for reading, see StorageFile. profile: what its messages are, as its writer
    names it: ros2, ros1, or "".

    To open it reads the summary and 64 bytes of each record outside of chunks, and unpacks only
    chunks that have no message index, or that define channels which the summary does not repeat.
    ValueError where it is damaged.
    """

    def __init__(self, path: Path):
        self.file = open(path, "rb", buffering=0)
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.chunks: list[Chunk] = []
        self.profile = ""
        try:
            summary_at, end, summary = self._summary()
            self.places = self._look_through(summary_at or end)
            self._take_summary(summary)
            self._complete()
            self.topics, self.times = self._topics(), self._times()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self.file.close()

    def messages(self, ids: Collection[int], start: int, stop: int) -> Stream:
        """Yield (channel id, log time, data) of channels, start <= time < stop, in order of
        time."""
        wanted = {*ids}
        sources: list[tuple[int, Callable[[], Stream]]] = [
            (chunk.start, partial(self._of_chunk, chunk, wanted, start, stop))
            for chunk in self.chunks
            if chunk.start < stop and start <= chunk.end and not wanted.isdisjoint(chunk.counts)]
        if len(self.places):
            sources.append((int(self.places["time"][0]),
                            partial(self._outside_chunks, wanted, start, stop)))
        return in_time_order(sources)

    def _of_chunk(self, chunk: Chunk, wanted: set[int], start: int, stop: int) -> Stream:
        data, found = self._unpacked(chunk), []
        for kind, at, length in _records(partial(_part, data), 0, len(data)):
            if kind == MESSAGE:
                channel, _, time, _ = MESSAGE_HEAD.unpack_from(data, at)
                if not chunk.start <= time <= chunk.end:
                    raise ValueError("a chunk of it has messages outside of its times")
                if channel in wanted and start <= time < stop:
                    found.append((time, channel, at + MESSAGE_HEAD.size, at + length))
        found.sort(key=itemgetter(0))
        for time, channel, begin, end in found:
            yield channel, time, data[begin:end]

    def _outside_chunks(self, wanted: set[int], start: int, stop: int) -> Stream:
        begin, end = np.searchsorted(self.places["time"], (start, stop))
        for time, channel, at, size in self.places[begin:end].tolist():
            if channel in wanted:
                yield channel, time, self._read(at, size)

    def _read(self, at: int, size: int) -> bytes:
        return os.pread(self.file.fileno(), size, at)

    def _summary(self) -> tuple[int, int, bytes]:
        """Return where the summary begins (0 without one) and the footer, and the summary."""
        size = os.fstat(self.file.fileno()).st_size
        end = size - len(MAGIC) - FOOTER_BYTES
        footer = self._read(max(end, 0), FOOTER_BYTES + len(MAGIC))
        if self._read(0, len(MAGIC)) != MAGIC or end < len(MAGIC) or not footer.endswith(MAGIC) \
                or RECORD.unpack_from(footer) != (FOOTER, 20):
            raise ValueError("it has no footer")
        summary_at, _, checksum = struct.unpack_from("<QQI", footer, RECORD.size)
        if summary_at == 0:
            return 0, end, b""
        if not len(MAGIC) <= summary_at <= end:
            raise ValueError("its index lies outside the file")
        summary = self._read(summary_at, end - summary_at)
        if checksum and crc32(footer[:FOOTER_BYTES - 4], crc32(summary)) != checksum:
            raise ValueError("the checksum of its index is wrong")
        return summary_at, end, summary

    def _look_through(self, end: int) -> np.ndarray:
        """Look at each record of the data section, which reaches to `end` or to its own end before
        it. Return the messages outside of chunks, (M,) PLACE with ascending times."""
        places, last = [], len(MAGIC)
        for kind, at, length in _records(self._read, len(MAGIC), end):
            last = at + length
            if kind == HEADER:
                self.profile = _string(self._read(at, length), 0)[0].decode(errors="replace")
            elif kind == MESSAGE:
                channel, _, time, _ = MESSAGE_HEAD.unpack(self._read(at, MESSAGE_HEAD.size))
                places.append((_checked(time), channel, at + MESSAGE_HEAD.size,
                               length - MESSAGE_HEAD.size))
            elif kind == CHUNK:
                self.chunks.append(_chunk(self._read(at, HEAD_BYTES), at, length))
            elif kind == MESSAGE_INDEX and self.chunks:
                channel, size = struct.unpack("<HI", self._read(at, 6))
                if size:
                    self.chunks[-1].counts[channel] = size // ENTRY_BYTES
            elif kind in (SCHEMA, CHANNEL):
                self._learn(kind, self._read(at, length))
            elif kind == DATA_END:
                break
        if last != end:
            raise ValueError("its data do not end where its index begins")
        found = np.array(places, PLACE)
        return found[np.argsort(found["time"], kind="stable")]

    def _take_summary(self, summary: bytes) -> None:
        indexed = []
        for kind, at, length in _records(partial(_part, summary), 0, len(summary)):
            if kind in (SCHEMA, CHANNEL):
                self._learn(kind, summary[at:at + length])
            elif kind == CHUNK_INDEX:
                indexed.append(_indexed(summary[at:at + length]))
        if indexed and sorted(indexed) != sorted(chunk.place for chunk in self.chunks):
            raise ValueError("its index does not fit its data")

    def _learn(self, kind: int, content: bytes) -> None:
        """Take what a record says of a schema or a channel, the first time that it comes."""
        stream = ReadDataStream(BytesIO(content))
        if kind == SCHEMA:
            schema = Schema.read(stream)
            self.schemas.setdefault(schema.id, schema)
        else:
            channel = Channel.read(stream)
            self.channels.setdefault(channel.id, channel)

    def _complete(self) -> None:
        """Unpack the chunks that no message index counts, and from the first on as many as are
        needed to know all channels with messages."""
        before = iter(self.chunks)
        for chunk in self.chunks:
            if not chunk.counts:
                self._look_into(chunk)
            while not self._knows(chunk.counts):
                self._look_into(next(before))
        if not self._knows(np.unique(self.places["channel"]).tolist()):
            raise ValueError("it does not define a channel that has messages")

    def _knows(self, ids: Collection[int]) -> bool:
        known = self.channels
        return all(i in known and known[i].schema_id in (0, *self.schemas) for i in ids)

    def _look_into(self, chunk: Chunk) -> None:
        data, counts = self._unpacked(chunk), dict[int, int]()
        for kind, at, length in _records(partial(_part, data), 0, len(data)):
            if kind in (SCHEMA, CHANNEL):
                self._learn(kind, data[at:at + length])
            elif kind == MESSAGE:
                channel, = struct.unpack_from("<H", data, at)
                counts[channel] = counts.get(channel, 0) + 1
        chunk.counts = chunk.counts or counts

    def _unpacked(self, chunk: Chunk) -> bytes:
        *_, packing, packed, size = chunk.place
        data = decompress(self._read(chunk.at, packed), packing.decode(), size)
        if chunk.crc and crc32(data) != chunk.crc:
            raise ValueError("the checksum of a chunk is wrong")
        return data

    def _topics(self) -> list[Topic]:
        numbers, found = np.unique(self.places["channel"], return_counts=True)
        counts = dict(zip(numbers.tolist(), found.tolist()))
        for chunk in self.chunks:
            for channel, count in chunk.counts.items():
                counts[channel] = counts.get(channel, 0) + count
        return [Topic(number, channel.topic, getattr(self.schemas.get(channel.schema_id), "name",
                                                     ""),
                      channel.message_encoding, channel.metadata.get("offered_qos_profiles", ""),
                      counts.get(number, 0)) for number, channel in sorted(self.channels.items())]

    def _times(self) -> tuple[int, int] | None:
        spans = [(chunk.start, chunk.end) for chunk in self.chunks if chunk.counts]
        if len(self.places):
            spans.append((int(self.places["time"][0]), int(self.places["time"][-1])))
        return (min(s for s, _ in spans), max(e for _, e in spans)) if spans else None


def _records(read: Callable[[int, int], bytes], at: int, end: int
             ) -> Iterator[tuple[int, int, int]]:
    """Yield the kind of each record, where its content begins, and its length. ValueError if the
    last one reaches past `end`."""
    while at < end:
        kind, length = RECORD.unpack(read(at, RECORD.size))
        at += RECORD.size
        if at + length > end:
            raise ValueError("a record of it is cut")
        yield kind, at, length
        at += length


def _part(data: bytes, at: int, size: int) -> bytes:
    return data[at:at + size]


def _chunk(head: bytes, at: int, length: int) -> Chunk:
    """Read the head of a chunk, of which `length` bytes begin at `at`."""
    start, end, size, crc = struct.unpack_from("<QQQI", head)
    packing, sizes = _string(head, 28)
    packed, = struct.unpack_from("<Q", head, sizes)
    if size > MAX_BYTES:
        raise ValueError(f"a chunk declares a decompressed size of {size} bytes; at most "
                         f"{MAX_BYTES} are allowed")
    begin, whole = at - RECORD.size, RECORD.size + length
    return Chunk((begin, whole, start, end, packing, packed, size), _checked(start), _checked(end),
                 at + sizes + 8, crc)


def _indexed(record: bytes) -> tuple[int, int, int, int, bytes, int, int]:
    """Return what an index says of a chunk: where it begins, its length, times, compression, and
    sizes, compressed and not."""
    start, end, begin, whole, offsets = struct.unpack_from("<QQQQI", record)
    packing, sizes = _string(record, 36 + offsets + 8)
    return (begin, whole, start, end, packing, *struct.unpack_from("<QQ", record, sizes))


def _checked(time: int) -> int:
    if time >= END:
        raise ValueError(f"it has {time} for a time in nanoseconds")
    return time


def _string(record: bytes, at: int) -> tuple[bytes, int]:
    """Return a string and where it ends."""
    length, = struct.unpack_from("<I", record, at)
    return record[at + 4:at + 4 + length], at + 4 + length
