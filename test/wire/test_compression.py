"""Decompression, including decompression bombs."""

from __future__ import annotations

import gzip
import tracemalloc
import zlib

import lz4.frame
import pytest
import zstandard

from lidar_perception.wire.compression import MAX_BYTES, decompress, decompress_message

PACK = {
    "zstd": zstandard.ZstdCompressor().compress,
    "lz4": lz4.frame.compress,
    "zlib": zlib.compress,
    "": lambda data: data,
}


@pytest.mark.parametrize("packing", PACK)
@pytest.mark.parametrize("known", [True, False])
def test_data_are_decompressed(packing, known):
    for data in b"", b"x", bytes(range(256)) * 999:
        assert decompress(PACK[packing](data), packing, len(data) if known else None) == data


@pytest.mark.parametrize("packing", ["zstd", "lz4", "zlib"])
@pytest.mark.parametrize("declared", [0, 1000, MAX_BYTES + 1])
def test_decompression_bomb_takes_no_memory(packing, declared):
    bomb = PACK[packing](bytes(2**27))
    assert len(bomb) < 2**20
    tracemalloc.start()
    with pytest.raises(ValueError, match="a chunk de"):
        decompress(bomb, packing, declared)
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()


def test_decompression_bomb_of_several_frames_is_rejected():
    bomb = PACK["zstd"](bytes(1000)) + PACK["zstd"](bytes(2**27))
    with pytest.raises(ValueError, match="more than 1000 bytes"):
        decompress(bomb, "zstd", 1000)


def test_wrong_size_or_compression_is_rejected():
    with pytest.raises(ValueError, match="decompresses to 1 bytes instead of 2"):
        decompress(b"x", "", 2)
    with pytest.raises(ValueError, match="unknown compression 'brotli'"):
        decompress(b"x", "brotli", 1)


def test_zlib_accepts_gzip_header():
    assert decompress(gzip.compress(b"data"), "zlib", None) == b"data"


def test_only_compressed_messages_are_decompressed():
    cdr = b"\0\1\0\0data"
    assert decompress_message(cdr) == decompress_message(PACK["zstd"](cdr)) == cdr
    stream = zstandard.ZstdCompressor().compressobj()  # does not declare the content size
    assert decompress_message(stream.compress(cdr) + stream.flush()) == cdr
