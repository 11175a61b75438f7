"""Whether the index at the end of an MCAP file fits its data: readers believe it, so that damage in
it changes what they read without a word. The format is that of mcap.dev/spec."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from zlib import crc32

from lidar_perception.data.unpacking import MAX_CHUNK

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, MESSAGE, CHUNK, CHUNK_INDEX, DATA_END = 0x01, 0x02, 0x05, 0x06, 0x08, 0x0F
HEAD_BYTES = 64  # of a record, looked at
FOOTER_BYTES = 9 + 20
RECORD = struct.Struct("<BQ")  # of each: its kind, and how many bytes follow
NO_INDEX = (RECORD.pack(DATA_END, 4) + bytes(4) + RECORD.pack(FOOTER, 20) + bytes(20)
            + MAGIC)  # the end of a file that has none


def check_index(path: Path) -> int | None:
    """How many chunks the index at the end of the file names; None for a file without one.
    ValueError, which says why, if it has another checksum than it says, or does not name each chunk
    of the data as it is there, or if a chunk is larger than MAX_CHUNK. Reads the index, and 64
    bytes of each record, whatever their size."""
    with open(path, "rb") as stream:
        file, size = stream.fileno(), os.fstat(stream.fileno()).st_size
        footer_at = size - len(MAGIC) - FOOTER_BYTES
        footer = os.pread(file, FOOTER_BYTES, max(footer_at, 0))
        if footer_at < len(MAGIC) or RECORD.unpack_from(footer) != (FOOTER, 20):
            raise ValueError("it has no footer")
        index_at, _, checksum = struct.unpack_from("<QQI", footer, RECORD.size)
        if index_at == 0:
            return None
        if not len(MAGIC) <= index_at <= footer_at:
            raise ValueError("its index lies outside the file")
        index = os.pread(file, footer_at - index_at, index_at)
        if checksum and crc32(footer[:-4], crc32(index)) != checksum:
            raise ValueError("the checksum of its index is wrong")
        chunks = sorted(_chunks(file, index_at))
        if sorted(_indexed(index)) != chunks:
            raise ValueError("its index does not fit its data")
        return len(chunks)


def profile_of(path: Path) -> str | None:
    """Of what its messages are, as a writer names it: ros2, ros1, or "" where it does not say; None
    where this is no MCAP file."""
    with open(path, "rb") as stream:
        head = stream.read(256)
    if not head.startswith(MAGIC) or len(head) < 64 or head[len(MAGIC)] != HEADER:
        return None
    return _string(head, len(MAGIC) + RECORD.size)[0].decode(errors="replace")


def _indexed(index: bytes) -> Iterator[tuple]:
    """What the index says of each chunk: position, length, times, compression and sizes."""
    at = 0
    while at < len(index):
        kind, length = RECORD.unpack_from(index, at)
        at += RECORD.size
        if at + length > len(index):
            raise ValueError("its index is cut")
        if kind == CHUNK_INDEX:
            record = index[at:at + length]
            *times, start, whole, offsets = struct.unpack_from("<QQQQI", record)
            packing, sizes = _string(record, 36 + offsets + 8)
            yield start, whole, *times, packing, *struct.unpack_from("<QQ", record, sizes)
        at += length


def _chunks(file: int, end: int) -> Iterator[tuple]:
    """The same of each chunk that is there."""
    for at, kind, length, head in records(file, end):
        if kind == CHUNK:
            *times, unpacked, _ = struct.unpack_from("<QQQI", head, RECORD.size)
            packing, sizes = _string(head, RECORD.size + 28)
            packed, = struct.unpack_from("<Q", head, sizes)
            if unpacked > MAX_CHUNK:
                raise ValueError(f"a chunk of it is said to unpack to {unpacked} bytes")
            yield at, RECORD.size + length, *times, packing, packed, unpacked


def records(file: int, end: int) -> Iterator[tuple[int, int, int, bytes]]:
    """Of each record of the data: where it begins, its kind, how many bytes follow its RECORD, and
    its first HEAD_BYTES. ValueError if the last does not end where the index begins, at end."""
    at, kind = len(MAGIC), 0
    while at < end and kind != DATA_END:
        head = os.pread(file, HEAD_BYTES, at)
        kind, length = RECORD.unpack_from(head)
        yield at, kind, length, head
        at += RECORD.size + length
    if at != end:
        raise ValueError("its data do not end where its index begins")


def _string(record: bytes, at: int) -> tuple[bytes, int]:
    """A string and where it ends."""
    length, = struct.unpack_from("<I", record, at)
    return record[at + 4:at + 4 + length], at + 4 + length
