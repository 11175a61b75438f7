"""A few bytes that unpack to gigabytes take no memory, in whatever way rosbags asks for them."""

from __future__ import annotations

import tracemalloc

import lz4.frame
import pytest
import zstandard
from rosbags.rosbag2 import storage_mcap

import lidar_perception.data.bag  # noqa: F401  it is what makes rosbags careful
from lidar_perception.data.unpacking import MAX_CHUNK

PACK = {"zstd": zstandard.ZstdCompressor().compress, "lz4": lz4.frame.compress,
        "": lambda data: data}
each = pytest.mark.parametrize("packing", PACK)


@each
def test_what_says_its_size_unpacks(packing):
    for data in b"", b"x", bytes(range(256)) * 999:
        assert storage_mcap.decompress(PACK[packing](data), packing, len(data), 0) == data


@pytest.mark.parametrize("packing", ["zstd", "lz4"])
@pytest.mark.parametrize("said", [0, 1000, MAX_CHUNK + 1])
def test_a_bomb_takes_no_memory(packing, said):
    bomb = PACK[packing](bytes(2**27))
    assert len(bomb) < 2**20
    tracemalloc.start()
    with pytest.raises(ValueError, match="a chunk of it"):
        storage_mcap.decompress(bomb, packing, said, 0)
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()


def test_a_bomb_of_several_frames_is_one():
    bomb = PACK["zstd"](bytes(1000)) + PACK["zstd"](bytes(2**27))
    with pytest.raises(ValueError, match="more than the 1000 bytes"):
        storage_mcap.decompress(bomb, "zstd", 1000, 0)
