"""Chunks of MCAP files unpack to what they say at most: a few bytes can unpack to gigabytes."""

from __future__ import annotations

import lz4.frame
import zstandard
from rosbags.rosbag2 import storage_mcap

MAX_CHUNK = 2**28  # bytes that a chunk may unpack to; recorders write some megabytes


def zstd(data: bytes, size: int) -> bytes:
    """What data unpack to, of which there must be size bytes. ValueError if there are more."""
    with zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True) as stream:
        return _bounded(stream.read(_checked(size) + 1), size)


def lz4_frame(data: bytes, size: int) -> bytes:
    """The same of LZ4 frames."""
    return _bounded(lz4.frame.LZ4FrameDecompressor().decompress(data, _checked(size) + 1), size)


def _checked(size: int) -> int:
    if size > MAX_CHUNK:
        raise ValueError(f"a chunk of it is said to unpack to {size} bytes")
    return size


def _bounded(unpacked: bytes, size: int) -> bytes:
    if len(unpacked) > size:
        raise ValueError(f"a chunk of it unpacks to more than the {size} bytes that it says")
    return unpacked


# rosbags unpacks with what this table names.
storage_mcap.DECOMPRESSORS.update(zstd=zstd, lz4=lz4_frame)
