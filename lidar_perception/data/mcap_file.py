"""Reader of MCAP files, with or without chunks, indexes, statistics and repeated channels.

Channels, counts and locations of messages come from the data section, which is compared with the
summary to detect damage. Format: https://mcap.dev/spec.
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

from lidar_perception.data.storage import END, Stream, Topic, merge_streams
from lidar_perception.wire.compression import MAX_BYTES, decompress

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = 1, 2, 3, 4, 5, 6
MESSAGE_INDEX, CHUNK_INDEX, DATA_END = 7, 8, 15
HEAD_BYTES = 64  # bytes to read from a record before its content
RECORD = struct.Struct("<BQ")  # record type, and number of bytes that follow
FOOTER_BYTES = RECORD.size + 20
NO_INDEX = (
    RECORD.pack(DATA_END, 4) + bytes(4) + RECORD.pack(FOOTER, 20) + bytes(20) + MAGIC
)  # end of a file without an index
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, number, log time, publish time
ENTRY_BYTES = 16  # bytes per message in a message index
LOCATION = np.dtype([("time", np.int64), ("channel", np.uint16), ("offset", np.int64), ("bytes", np.int64)])


@dataclass
class Chunk:
    """A chunk of an MCAP file.

    Attributes:
        index_entry: the chunk's entry in an index, see _parse_chunk_index.
        start, end: times in its header, ns.
        offset: offset of the compressed data in the file.
        crc: checksum of the decompressed data, 0 for none.
        counts: number of messages by channel.
    """

    index_entry: tuple[int, int, int, int, bytes, int, int]
    start: int
    end: int
    offset: int
    crc: int
    counts: dict[int, int] = field(default_factory=dict)


class McapFile:
    """An MCAP file open for reading, see StorageFile.

    Opening reads the summary and HEAD_BYTES of each record outside of chunks. It decompresses only
    chunks without a message index, and those that define channels which the summary lacks.

    Attributes:
        profile: message format as stated by the writer: ros2, ros1, or "".

    Raises:
        ValueError: the file is damaged.
    """

    def __init__(self, path: Path):
        self.file = open(path, "rb", buffering=0)
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.chunks: list[Chunk] = []
        self.profile = ""
        try:
            summary_offset, end, summary = self._read_summary()
            self.locations = self._scan_data_section(summary_offset or end)
            self._check_summary(summary)
            self._complete_definitions()
            self.topics, self.times = self._make_topics(), self._find_times()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self.file.close()

    def read_messages(self, ids: Collection[int], start: int, stop: int) -> Stream:
        """Yield (channel id, log time, data) of channels with start <= time < stop, in order of time."""
        channels = {*ids}
        sources: list[tuple[int, Callable[[], Stream]]] = [
            (chunk.start, partial(self._read_messages_in_chunk, chunk, channels, start, stop))
            for chunk in self.chunks
            if chunk.start < stop and start <= chunk.end and not channels.isdisjoint(chunk.counts)
        ]
        if len(self.locations):
            sources.append(
                (int(self.locations["time"][0]), partial(self._read_messages_outside_chunks, channels, start, stop))
            )
        return merge_streams(sources)

    def _read_messages_in_chunk(self, chunk: Chunk, channels: set[int], start: int, stop: int) -> Stream:
        data, messages = self._read_chunk(chunk), []
        for record_type, offset, length in _iterate_records(partial(_slice, data), 0, len(data)):
            if record_type == MESSAGE:
                channel, _, time, _ = MESSAGE_HEAD.unpack_from(data, offset)
                if not chunk.start <= time <= chunk.end:
                    raise ValueError("a chunk has messages outside its time range")
                if channel in channels and start <= time < stop:
                    messages.append((time, channel, offset + MESSAGE_HEAD.size, offset + length))
        messages.sort(key=itemgetter(0))
        for time, channel, begin, end in messages:
            yield channel, time, data[begin:end]

    def _read_messages_outside_chunks(self, channels: set[int], start: int, stop: int) -> Stream:
        begin, end = np.searchsorted(self.locations["time"], (start, stop))
        for time, channel, offset, size in self.locations[begin:end].tolist():
            if channel in channels:
                yield channel, time, self._read(offset, size)

    def _read(self, offset: int, size: int) -> bytes:
        return os.pread(self.file.fileno(), size, offset)

    def _read_summary(self) -> tuple[int, int, bytes]:
        """Return the offsets of the summary (0 without one) and of the footer, and the summary."""
        size = os.fstat(self.file.fileno()).st_size
        end = size - len(MAGIC) - FOOTER_BYTES
        footer = self._read(max(end, 0), FOOTER_BYTES + len(MAGIC))
        if (
            self._read(0, len(MAGIC)) != MAGIC
            or end < len(MAGIC)
            or not footer.endswith(MAGIC)
            or RECORD.unpack_from(footer) != (FOOTER, 20)
        ):
            raise ValueError("the footer is missing")
        summary_offset, _, checksum = struct.unpack_from("<QQI", footer, RECORD.size)
        if summary_offset == 0:
            return 0, end, b""
        if not len(MAGIC) <= summary_offset <= end:
            raise ValueError("the index is outside the file")
        summary = self._read(summary_offset, end - summary_offset)
        if checksum and crc32(footer[: FOOTER_BYTES - 4], crc32(summary)) != checksum:
            raise ValueError("the checksum of the index is wrong")
        return summary_offset, end, summary

    def _scan_data_section(self, end: int) -> np.ndarray:
        """Read the head of each record in the data section, up to `end`.

        Returns:
            The messages outside of chunks, (M,) LOCATION with ascending times.
        """
        locations, last_end = [], len(MAGIC)
        for record_type, offset, length in _iterate_records(self._read, len(MAGIC), end):
            last_end = offset + length
            if record_type == HEADER:
                self.profile = _parse_string(self._read(offset, length), 0)[0].decode(errors="replace")
            elif record_type == MESSAGE:
                channel, _, time, _ = MESSAGE_HEAD.unpack(self._read(offset, MESSAGE_HEAD.size))
                locations.append((_check_time(time), channel, offset + MESSAGE_HEAD.size, length - MESSAGE_HEAD.size))
            elif record_type == CHUNK:
                self.chunks.append(_parse_chunk(self._read(offset, HEAD_BYTES), offset, length))
            elif record_type == MESSAGE_INDEX and self.chunks:
                channel, size = struct.unpack("<HI", self._read(offset, 6))
                if size:
                    self.chunks[-1].counts[channel] = size // ENTRY_BYTES
            elif record_type in (SCHEMA, CHANNEL):
                self._add_definition(record_type, self._read(offset, length))
            elif record_type == DATA_END:
                break
        if last_end != end:
            raise ValueError("the data section does not end where the index begins")
        messages = np.array(locations, LOCATION)
        return messages[np.argsort(messages["time"], kind="stable")]

    def _check_summary(self, summary: bytes) -> None:
        index_entries = []
        for record_type, offset, length in _iterate_records(partial(_slice, summary), 0, len(summary)):
            if record_type in (SCHEMA, CHANNEL):
                self._add_definition(record_type, summary[offset : offset + length])
            elif record_type == CHUNK_INDEX:
                index_entries.append(_parse_chunk_index(summary[offset : offset + length]))
        if index_entries and sorted(index_entries) != sorted(chunk.index_entry for chunk in self.chunks):
            raise ValueError("the index does not match the data")

    def _add_definition(self, record_type: int, content: bytes) -> None:
        """Add the definition of a schema or channel, unless its id is already defined."""
        stream = ReadDataStream(BytesIO(content))
        if record_type == SCHEMA:
            schema = Schema.read(stream)
            self.schemas.setdefault(schema.id, schema)
        else:
            channel = Channel.read(stream)
            self.channels.setdefault(channel.id, channel)

    def _complete_definitions(self) -> None:
        """Decompress chunks without a message index, and earlier chunks until all channels with
        messages are defined."""
        earlier_chunks = iter(self.chunks)
        for chunk in self.chunks:
            if not chunk.counts:
                self._scan_chunk(chunk)
            while not self._has_definitions(chunk.counts):
                self._scan_chunk(next(earlier_chunks))
        if not self._has_definitions(np.unique(self.locations["channel"]).tolist()):
            raise ValueError("the definition of a channel with messages is missing")

    def _has_definitions(self, ids: Collection[int]) -> bool:
        channels = self.channels
        return all(i in channels and channels[i].schema_id in (0, *self.schemas) for i in ids)

    def _scan_chunk(self, chunk: Chunk) -> None:
        data, counts = self._read_chunk(chunk), dict[int, int]()
        for record_type, offset, length in _iterate_records(partial(_slice, data), 0, len(data)):
            if record_type in (SCHEMA, CHANNEL):
                self._add_definition(record_type, data[offset : offset + length])
            elif record_type == MESSAGE:
                (channel,) = struct.unpack_from("<H", data, offset)
                counts[channel] = counts.get(channel, 0) + 1
        chunk.counts = chunk.counts or counts

    def _read_chunk(self, chunk: Chunk) -> bytes:
        *_, compression, compressed_size, size = chunk.index_entry
        data = decompress(self._read(chunk.offset, compressed_size), compression.decode(), size)
        if chunk.crc and crc32(data) != chunk.crc:
            raise ValueError("the checksum of a chunk is wrong")
        return data

    def _make_topics(self) -> list[Topic]:
        channel_ids, message_counts = np.unique(self.locations["channel"], return_counts=True)
        counts = dict(zip(channel_ids.tolist(), message_counts.tolist()))
        for chunk in self.chunks:
            for channel, count in chunk.counts.items():
                counts[channel] = counts.get(channel, 0) + count
        return [
            Topic(
                channel_id,
                channel.topic,
                getattr(self.schemas.get(channel.schema_id), "name", ""),
                channel.message_encoding,
                channel.metadata.get("offered_qos_profiles", ""),
                counts.get(channel_id, 0),
            )
            for channel_id, channel in sorted(self.channels.items())
        ]

    def _find_times(self) -> tuple[int, int] | None:
        spans = [(chunk.start, chunk.end) for chunk in self.chunks if chunk.counts]
        if len(self.locations):
            spans.append((int(self.locations["time"][0]), int(self.locations["time"][-1])))
        return (min(s for s, _ in spans), max(e for _, e in spans)) if spans else None


def _iterate_records(read: Callable[[int, int], bytes], offset: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Yield the type, the offset of the content, and the length of each record.

    Raises ValueError if the last record extends beyond `end`.
    """
    while offset < end:
        record_type, length = RECORD.unpack(read(offset, RECORD.size))
        offset += RECORD.size
        if offset + length > end:
            raise ValueError("the last record is truncated")
        yield record_type, offset, length
        offset += length


def _slice(data: bytes, offset: int, size: int) -> bytes:
    return data[offset : offset + size]


def _parse_chunk(head: bytes, offset: int, length: int) -> Chunk:
    """Parse the head of a chunk, whose content has `length` bytes and starts at `offset`."""
    start, end, size, crc = struct.unpack_from("<QQQI", head)
    compression, sizes = _parse_string(head, 28)
    (compressed_size,) = struct.unpack_from("<Q", head, sizes)
    if size > MAX_BYTES:
        raise ValueError(f"a chunk declares a decompressed size of {size} bytes; at most {MAX_BYTES} are allowed")
    begin, total = offset - RECORD.size, RECORD.size + length
    return Chunk(
        (begin, total, start, end, compression, compressed_size, size),
        _check_time(start),
        _check_time(end),
        offset + sizes + 8,
        crc,
    )


def _parse_chunk_index(record: bytes) -> tuple[int, int, int, int, bytes, int, int]:
    """Parse an index entry of a chunk.

    Returns:
        Offset, length, start and end time, compression, compressed and uncompressed size.
    """
    start, end, begin, total, offsets = struct.unpack_from("<QQQQI", record)
    compression, sizes = _parse_string(record, 36 + offsets + 8)
    return (begin, total, start, end, compression, *struct.unpack_from("<QQ", record, sizes))


def _check_time(time: int) -> int:
    if time >= END:
        raise ValueError(f"{time} is not a valid time in nanoseconds")
    return time


def _parse_string(record: bytes, offset: int) -> tuple[bytes, int]:
    """Parse a string; return it and the offset of its end."""
    (length,) = struct.unpack_from("<I", record, offset)
    return record[offset + 4 : offset + 4 + length], offset + 4 + length
