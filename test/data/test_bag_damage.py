"""Bags that stand in the way, are damaged, or are none: nothing is lost, and each is named."""

from __future__ import annotations

import resource
import shutil
import struct

import numpy as np
import pytest
from bag_samples import cloud_frame, message_bytes, same_cloud, scans
from mcap.reader import make_reader
from mcap.writer import Writer
from samples import STAMP, header, scene, write

from lidar_perception.data import bag as bag_module
from lidar_perception.data.bag import Bag, BagWriter
from lidar_perception.data.frame import Frame
from lidar_perception.data.open import open_recording
from lidar_perception.data.to_bag import write_bag
from lidar_perception.testing.bags import copy_bag
from lidar_perception.types import InputError
from lidar_perception.wire.codec import bag_message
from lidar_perception.wire.topics import POINTS
from msg_utils.point_cloud2 import from_array


def test_an_existing_bag_is_replaced_only_by_force(tmp_path):
    path = tmp_path / "bag"
    write_bag(path, scans(1))
    before = message_bytes(path)
    with pytest.raises(InputError, match=r"exists already.*--force"):
        write_bag(path, scans(2))
    assert message_bytes(path) == before
    write_bag(path, scans(2), force=True)
    assert len(open_recording(path)) == 2


@pytest.mark.parametrize("make", [lambda p: write(p / "bag", b"text"),
                                  lambda p: write(p / "bag/notes.txt", b"text")])
def test_force_replaces_nothing_but_bags(tmp_path, make):
    kept = make(tmp_path)
    with pytest.raises(InputError, match="is no bag"):
        write_bag(tmp_path / "bag", scans(1), force=True)
    assert kept.read_bytes() == b"text"
    write_bag(tmp_path / "other", scans(1))
    notes = write(tmp_path / "other/notes.txt", b"text")
    with pytest.raises(InputError, match=r"other files too \(1, such as notes.txt\)"):
        write_bag(tmp_path / "other", scans(1), force=True)
    assert notes.read_bytes() == b"text"


@pytest.mark.parametrize("force", [False, True])
def test_an_exception_leaves_the_old_bag_and_an_incomplete_one_that_can_be_read(tmp_path, force):
    path = tmp_path / "bag"
    if force:
        write_bag(path, scans(1))
    before = message_bytes(path) if force else None

    def failing():
        yield from scans(2)
        raise RuntimeError("power cut")

    with pytest.raises(RuntimeError, match="power cut"):
        write_bag(path, failing(), force=force)
    assert len(list(open_recording(tmp_path / "bag.incomplete"))) == 2
    assert (message_bytes(path) == before) if force else not path.exists()
    write_bag(path, scans(3), force=force)  # what is left over is no obstacle
    assert len(open_recording(path)) == 3
    assert not (tmp_path / "bag.incomplete").exists()


def test_a_place_that_cannot_hold_a_bag_is_named(tmp_path):
    write(tmp_path / "file", b"")
    with pytest.raises(InputError, match=r"cannot make the folder .*file/bag"):
        write_bag(tmp_path / "file/bag", scans(1))


@pytest.fixture
def room():
    """room(bytes): no file may grow larger; a write beyond fails as it does on a full disk."""
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, hard))


@pytest.mark.no_cover
def test_on_a_full_disk_what_found_room_can_be_read(tmp_path, monkeypatch, room):
    """Wherever it gets full: in a chunk, in the index, in metadata.yaml."""
    monkeypatch.setattr(bag_module, "CHUNK_BYTES", 20_000)
    rng = np.random.default_rng(0)
    drive = [Frame.of(str(i), cloud_frame(rng.random((1000, 4), np.float32), STAMP + i))
             for i in range(5)]
    write_bag(tmp_path / "all", drive)
    whole = message_bytes(tmp_path / "all")
    size = (tmp_path / "all/all.mcap").stat().st_size
    read = []
    for full in [*range(10_000, size, 6007), *range(size - 400, size, 7)]:
        room(full)
        with pytest.raises(InputError, match=r"cannot write the bag .*bag\.incomplete") as error:
            write_bag(tmp_path / "bag", drive)
        room(resource.RLIM_INFINITY)
        assert "\n" not in str(error.value) and not (tmp_path / "bag").exists()
        rows = message_bytes(tmp_path / "bag.incomplete")
        assert rows == whole[:len(rows)]
        read.append(len(rows))
    assert read[0] == 0 and read[-1] == len(whole) and read == sorted(read)
    write_bag(tmp_path / "bag", drive)
    assert message_bytes(tmp_path / "bag") == whole


def test_a_second_writer_of_the_same_bag_leaves_the_first_alone(tmp_path):
    path, first = tmp_path / "bag", scans(2)

    def slow():
        yield first[0]
        for force in (False, True):
            with pytest.raises(InputError, match="another process is writing"):
                write_bag(path, scans(1), force=force)
        yield first[1]

    write_bag(path, slow())
    assert len(open_recording(path)) == 2


def test_a_bag_that_came_while_waiting_to_write_is_kept(tmp_path):
    late = BagWriter(tmp_path / "bag")
    write_bag(tmp_path / "bag", scans(2))
    with pytest.raises(InputError, match="exists already"), late:
        pass
    assert len(open_recording(tmp_path / "bag")) == 2


def test_a_folder_without_metadata_is_read_by_its_one_file(written, tmp_path):
    shutil.copy(written / "drive.mcap", tmp_path)
    assert message_bytes(tmp_path) == message_bytes(written)
    assert message_bytes(tmp_path / "drive.mcap") == message_bytes(written)
    shutil.copy(written / "drive.mcap", tmp_path / "second.mcap")
    with pytest.raises(InputError, match=r"no metadata\.yaml and 2 storage files"):
        Bag(tmp_path)


def mcap_of(path, profile):
    with open(path, "wb") as stream:
        writer = Writer(stream)
        writer.start(profile=profile)
        writer.finish()


@pytest.mark.parametrize("name, make, words", [
    ("missing", lambda p: None, "there is no bag"),
    ("folder", lambda p: p.mkdir(), "no metadata.yaml and 0 storage files"),
    ("cloud.bin", lambda p: write(p, b"1234"), "is no bag"),
    ("empty.mcap", lambda p: write(p, b""), "truncated or damaged"),
    ("text.mcap", lambda p: write(p, b"text " * 100), "truncated or damaged"),
    ("old.mcap", lambda p: mcap_of(p, "ros1"), "messages of ROS 1 in MCAP; give the .bag"),
    ("other.mcap", lambda p: mcap_of(p, ""), "no bag of ROS 2 (profile ''), as Foxglove"),
    ("text.db3", lambda p: write(p, b"text " * 100), "truncated or damaged"),
    ("bag", lambda p: write(p / "metadata.yaml", "text"), "truncated or damaged"),
    ("bag", lambda p: write(p / "metadata.yaml", "a: [\n"), "truncated or damaged"),
])
def test_what_is_no_bag_is_named_in_one_line(tmp_path, name, make, words):
    make(tmp_path / name)
    with pytest.raises(InputError) as error:
        Bag(tmp_path / name)
    assert str(tmp_path / name) in str(error.value) and words in str(error.value)
    assert "\n" not in str(error.value)


def test_a_bag_without_its_file_is_damaged(written, tmp_path):
    shutil.copy(written / "metadata.yaml", tmp_path)
    with pytest.raises(InputError, match="truncated or damaged"):
        message_bytes(tmp_path)


@pytest.mark.parametrize("folder", [True, False])
@pytest.mark.no_cover
def test_a_bag_that_was_cut_anywhere_is_damaged(written, tmp_path, folder):
    raw = (written / "drive.mcap").read_bytes()
    if folder:
        shutil.copy(written / "metadata.yaml", tmp_path)
    path = tmp_path / "drive.mcap"
    for size in [*range(0, len(raw), 9973), *range(len(raw) - 12, len(raw))]:
        path.write_bytes(raw[:size])
        with pytest.raises(InputError, match="truncated or damaged"):
            message_bytes(tmp_path if folder else path)


def read_or_named(path):
    """The messages, or None where the bag says in one line that it is damaged."""
    try:
        with Bag(path) as bag:
            rows = list(bag.raw())
            assert {t: sum(row[0] == t for row in rows) for t in bag.topics} == bag.counts
        return rows
    except InputError as error:
        assert "truncated or damaged" in str(error) and "\n" not in str(error)
        return None


DAMAGES = {
    "deleted": lambda raw, at: raw[:at] + raw[at + 1:],
    "inserted": lambda raw, at: raw[:at] + b"\x91" + raw[at:],
    "flipped": lambda raw, at: raw[:at] + bytes([raw[at] ^ 1 << at % 8]) + raw[at + 1:],
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
@pytest.mark.no_cover
def test_a_damaged_byte_never_changes_what_is_read_without_a_word(written, tmp_path, damage):
    """In the data, at the head of a chunk, and in the index, from which readers take where the
    messages are."""
    raw, before = (written / "drive.mcap").read_bytes(), message_bytes(written)
    path, named = tmp_path / "drive.mcap", 0
    with open(written / "drive.mcap", "rb") as stream:
        chunk = make_reader(stream).get_summary().chunk_indexes[0].chunk_start_offset
    places = [*range(8, len(raw), len(raw) // 40), *range(chunk, chunk + 60, 3),
              *range(len(raw) - 4000, len(raw), 41)]
    for at in places:
        path.write_bytes(damage(raw, at))
        rows = read_or_named(path)
        assert rows in (None, before)
        named += rows is None
    assert named > 0.8 * len(places)


def test_an_index_without_a_checksum_is_compared_with_the_data(written, tmp_path):
    copy_bag(written, tmp_path / "plain", "mcap")
    source = tmp_path / "plain/plain.mcap"
    raw = source.read_bytes()
    with open(source, "rb") as stream:
        index = make_reader(stream).get_summary().chunk_indexes[0]
    at = raw.index(struct.pack("<QQQQ", index.message_start_time, index.message_end_time,
                               index.chunk_start_offset, index.chunk_length))
    assert read_or_named(source) == message_bytes(written)
    path = tmp_path / "drive.mcap"
    for byte in range(at, at + 32):
        path.write_bytes(DAMAGES["flipped"](raw, byte))
        assert read_or_named(path) is None


def test_a_chunk_that_says_it_unpacks_to_terabytes_is_not_unpacked(written, tmp_path):
    raw = bytearray((written / "drive.mcap").read_bytes())
    with open(written / "drive.mcap", "rb") as stream:
        at = make_reader(stream).get_summary().chunk_indexes[0].chunk_start_offset
    raw[at + 9 + 16:at + 9 + 24] = struct.pack("<Q", 2**41)
    (tmp_path / "drive.mcap").write_bytes(raw)
    with pytest.raises(InputError, match="size of 2199023255552 bytes"):
        Bag(tmp_path / "drive.mcap")


def test_a_bag_without_clouds_says_what_it_has(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/text", "std_msgs/msg/String")
        bag.write("/text", 1, bag_message("std_msgs/msg/String", data="hello"))
    with pytest.raises(InputError) as error:
        open_recording(tmp_path / "bag")
    for word in (str(tmp_path / "bag"), "no sensor_msgs/PointCloud2", "/text (std_msgs/msg/String)",
                 "driver"):
        assert word in str(error.value)


def test_a_cloud_that_cannot_be_used_leaves_the_others(tmp_path):
    cloud = scene()[:, :2].copy().view([("x", "<f4"), ("y", "<f4")]).reshape(-1)
    write_bag(tmp_path / "bag", scans(1))
    with BagWriter(tmp_path / "mixed") as bag:
        bag.add_topic(POINTS, "sensor_msgs/msg/PointCloud2")
        bag.write(POINTS, 1, from_array(cloud, header(bag_message, 1), bag_message))
        for topic, _, data in message_bytes(tmp_path / "bag"):
            if topic == POINTS:
                bag.write(POINTS, 2, data)
    flat, good = open_recording(tmp_path / "mixed")
    with pytest.raises(InputError, match=r"mixed, topic /points at 1 ns: .*no field 'z'"):
        flat.load()
    assert same_cloud(scene(), good.load().xyz)
