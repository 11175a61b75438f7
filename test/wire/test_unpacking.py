"""Decompression: a few bytes that unpack to gigabytes take no memory."""

from __future__ import annotations

import gzip
import tracemalloc
import zlib

import lz4.frame
import pytest
import zstandard

from lidar_perception.wire.unpacking import MAX_UNPACKED, unpack, unpack_message

PACK = {"zstd": zstandard.ZstdCompressor().compress, "lz4": lz4.frame.compress,
        "zlib": zlib.compress, "": lambda data: data}


@pytest.mark.parametrize("packing", PACK)
@pytest.mark.parametrize("known", [True, False])
def test_what_says_its_size_unpacks(packing, known):
    for data in b"", b"x", bytes(range(256)) * 999:
        assert unpack(PACK[packing](data), packing, len(data) if known else None) == data


@pytest.mark.parametrize("packing", ["zstd", "lz4", "zlib"])
@pytest.mark.parametrize("said", [0, 1000, MAX_UNPACKED + 1])
def test_a_bomb_takes_no_memory(packing, said):
    bomb = PACK[packing](bytes(2**27))
    assert len(bomb) < 2**20
    tracemalloc.start()
    with pytest.raises(ValueError, match="a chunk of it"):
        unpack(bomb, packing, said)
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()


def test_a_bomb_of_several_frames_is_one():
    bomb = PACK["zstd"](bytes(1000)) + PACK["zstd"](bytes(2**27))
    with pytest.raises(ValueError, match="more than the 1000 bytes"):
        unpack(bomb, "zstd", 1000)


def test_other_sizes_and_packings_are_refused():
    with pytest.raises(ValueError, match="unpacks to 1 bytes and not to 2"):
        unpack(b"x", "", 2)
    with pytest.raises(ValueError, match="compression 'brotli' is unknown"):
        unpack(b"x", "brotli", 1)


def test_zlib_takes_the_header_of_gzip_too():
    assert unpack(gzip.compress(b"data"), "zlib", None) == b"data"


def test_messages_are_unpacked_where_they_are_packed():
    cdr = b"\0\1\0\0data"
    assert unpack_message(cdr) == unpack_message(PACK["zstd"](cdr)) == cdr
    stream = zstandard.ZstdCompressor().compressobj()  # does not say the size of the content
    assert unpack_message(stream.compress(cdr) + stream.flush()) == cdr
