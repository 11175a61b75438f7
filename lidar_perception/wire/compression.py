"""Decompression with a size limit, because a few bytes can expand to gigabytes."""

from __future__ import annotations

import zlib

import lz4.frame
import zstandard

MAX_BYTES = 2**28  # max size of a decompressed chunk or message; recorders write a few megabytes
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


def decompress(data: bytes, compression: str, size: int | None) -> bytes:
    """Decompress data.

    Args:
        data: Compressed bytes.
        compression: "" (none), "zstd", "lz4" (frames) or "zlib" (with a zlib or gzip header).
        size: Size of the decompressed data in bytes, None if unknown.

    Raises:
        ValueError: The result has a different size or more than MAX_BYTES, the data are damaged, or
            the compression is unknown.
    """
    limit = MAX_BYTES if size is None else size
    if limit > MAX_BYTES:
        raise ValueError(f"a chunk declares a decompressed size of {size} bytes; at most {MAX_BYTES} are allowed")
    if compression == "":
        result = data
    elif compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True) as stream:
            result = stream.read(limit + 1)
    elif compression == "lz4":
        result = lz4.frame.LZ4FrameDecompressor().decompress(data, limit + 1)
    elif compression == "zlib":
        result = zlib.decompressobj(zlib.MAX_WBITS | 32).decompress(data, limit + 1)
    else:
        raise ValueError(f"unknown compression '{compression}'")
    if len(result) > limit:
        raise ValueError(f"a chunk decompresses to more than {limit} bytes")
    if size is not None and len(result) < size:
        raise ValueError(f"a chunk decompresses to {len(result)} bytes instead of {size}")
    return result


def decompress_message(data: bytes) -> bytes:
    """Decompress a message if rosbag2 compressed it (compression mode MESSAGE, zstd)."""
    if data[:4] != ZSTD_MAGIC:  # CDR begins with a zero byte
        return data
    size = zstandard.frame_content_size(data)
    return decompress(data, "zstd", None if size < 0 else size)
