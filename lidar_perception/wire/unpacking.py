"""Decompression with a bound on the result: a few bytes can unpack to gigabytes."""

from __future__ import annotations

import zlib

import lz4.frame
import zstandard

MAX_UNPACKED = 2**28  # bytes of a chunk or a message; recorders write some megabytes
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


def unpack(data: bytes, packing: str, size: int | None) -> bytes:
    """Return what data unpack to.

    Args:
        packing: "" (not compressed), "zstd", "lz4" (frames) or "zlib" (with its own or gzip's
            header).
        size: of the result, in bytes; None if unknown.

    Raises:
        ValueError: data unpack to another size, to more than MAX_UNPACKED, or not at all, or the
            packing is unknown.
    """
    limit = MAX_UNPACKED if size is None else size
    if limit > MAX_UNPACKED:
        raise ValueError(f"a chunk of it is said to unpack to {size} bytes")
    if packing == "":
        unpacked = data
    elif packing == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True) as stream:
            unpacked = stream.read(limit + 1)
    elif packing == "lz4":
        unpacked = lz4.frame.LZ4FrameDecompressor().decompress(data, limit + 1)
    elif packing == "zlib":
        unpacked = zlib.decompressobj(zlib.MAX_WBITS | 32).decompress(data, limit + 1)
    else:
        raise ValueError(f"its compression '{packing}' is unknown")
    if len(unpacked) > limit:
        raise ValueError(f"a chunk of it unpacks to more than the {limit} bytes that it says")
    if size is not None and len(unpacked) < size:
        raise ValueError(f"a chunk of it unpacks to {len(unpacked)} bytes and not to {size}")
    return unpacked


def unpack_message(data: bytes) -> bytes:
    """Return a CDR message, unpacked if rosbag2 compressed it (compression mode MESSAGE, zstd).

    CDR begins with a zero byte, so the first bytes tell the two apart.
    """
    if data[:4] != ZSTD_MAGIC:
        return data
    size = zstandard.frame_content_size(data)
    return unpack(data, "zstd", None if size < 0 else size)
