"""Existing and damaged bags: no data are lost, and each problem is reported."""

from __future__ import annotations

import resource
import shutil
import struct

import numpy as np
import pytest
from bag_samples import cloud_frame, message_bytes, same_cloud, scans
from mcap.reader import make_reader
from mcap.writer import Writer
from samples import STAMP, make_any_header, make_scene, write_file

from lidar_perception.data import bag as bag_module
from lidar_perception.data.bag import Bag, BagWriter
from lidar_perception.data.frame import Frame
from lidar_perception.data.open import open_recording
from lidar_perception.data.to_bag import write_bag
from lidar_perception.testing.bags import copy_bag
from lidar_perception.types import InputError
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.topics import POINTS
from msg_utils.point_cloud2 import from_array


def test_existing_bag_is_replaced_only_with_force(tmp_path):
    path = tmp_path / "bag"
    write_bag(path, scans(1))
    before = message_bytes(path)
    with pytest.raises(InputError, match=r"already exists.*--force"):
        write_bag(path, scans(2))
    assert message_bytes(path) == before
    write_bag(path, scans(2), force=True)
    assert len(open_recording(path)) == 2


@pytest.mark.parametrize(
    "make", [lambda p: write_file(p / "bag", b"text"), lambda p: write_file(p / "bag/notes.txt", b"text")]
)
def test_force_replaces_only_bags(tmp_path, make):
    path = make(tmp_path)
    with pytest.raises(InputError, match="is not a bag"):
        write_bag(tmp_path / "bag", scans(1), force=True)
    assert path.read_bytes() == b"text"
    write_bag(tmp_path / "other", scans(1))
    notes = write_file(tmp_path / "other/notes.txt", b"text")
    with pytest.raises(InputError, match=r"1 other files, such as notes.txt"):
        write_bag(tmp_path / "other", scans(1), force=True)
    assert notes.read_bytes() == b"text"


@pytest.mark.parametrize("force", [False, True])
def test_exception_keeps_old_bag_and_readable_partial_bag(tmp_path, force):
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
    write_bag(path, scans(3), force=force)  # the incomplete bag is replaced
    assert len(open_recording(path)) == 3
    assert not (tmp_path / "bag.incomplete").exists()


def test_invalid_target_folder_is_reported(tmp_path):
    write_file(tmp_path / "file", b"")
    with pytest.raises(InputError, match=r"cannot create the folder .*file/bag"):
        write_bag(tmp_path / "file/bag", scans(1))


@pytest.fixture
def limit_file_size():
    """Return a function that limits the size of files, to imitate a full disk."""
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, hard))


@pytest.mark.no_cover
def test_messages_written_before_the_disk_was_full_are_readable(tmp_path, monkeypatch, limit_file_size):
    """The disk becomes full while a chunk, the index or metadata.yaml is written."""
    monkeypatch.setattr(bag_module, "CHUNK_BYTES", 20_000)
    rng = np.random.default_rng(0)
    drive = [Frame.of(str(i), cloud_frame(rng.random((1000, 4), np.float32), STAMP + i)) for i in range(5)]
    write_bag(tmp_path / "all", drive)
    whole = message_bytes(tmp_path / "all")
    size = (tmp_path / "all/all.mcap").stat().st_size
    read = []
    for full in [*range(10_000, size, 6007), *range(size - 400, size, 7)]:
        limit_file_size(full)
        with pytest.raises(InputError, match=r"cannot write the bag .*bag\.incomplete") as error:
            write_bag(tmp_path / "bag", drive)
        limit_file_size(resource.RLIM_INFINITY)
        assert "\n" not in str(error.value) and not (tmp_path / "bag").exists()
        rows = message_bytes(tmp_path / "bag.incomplete")
        assert rows == whole[: len(rows)]
        read.append(len(rows))
    assert read[0] == 0 and read[-1] == len(whole) and read == sorted(read)
    write_bag(tmp_path / "bag", drive)
    assert message_bytes(tmp_path / "bag") == whole


def test_second_writer_of_the_same_bag_is_rejected(tmp_path):
    path, first = tmp_path / "bag", scans(2)

    def slow():
        yield first[0]
        for force in (False, True):
            with pytest.raises(InputError, match="another process is writing"):
                write_bag(path, scans(1), force=force)
        yield first[1]

    write_bag(path, slow())
    assert len(open_recording(path)) == 2


def test_bag_written_by_another_process_is_kept(tmp_path):
    late = BagWriter(tmp_path / "bag")
    write_bag(tmp_path / "bag", scans(2))
    with pytest.raises(InputError, match="already exists"), late:
        pass
    assert len(open_recording(tmp_path / "bag")) == 2


def test_folder_without_metadata_is_read_from_its_only_file(sample_bag, tmp_path):
    shutil.copy(sample_bag / "drive.mcap", tmp_path)
    assert message_bytes(tmp_path) == message_bytes(sample_bag)
    assert message_bytes(tmp_path / "drive.mcap") == message_bytes(sample_bag)
    shutil.copy(sample_bag / "drive.mcap", tmp_path / "second.mcap")
    with pytest.raises(InputError, match=r"no metadata\.yaml and 2 storage files"):
        Bag(tmp_path)


def write_empty_mcap(path, profile):
    with open(path, "wb") as stream:
        writer = Writer(stream)
        writer.start(profile=profile)
        writer.finish()


@pytest.mark.parametrize(
    "name, make, words",
    [
        ("missing", lambda p: None, "does not exist"),
        ("folder", lambda p: p.mkdir(), "no metadata.yaml and 0 storage files"),
        ("cloud.bin", lambda p: write_file(p, b"1234"), "is not a bag"),
        ("empty.mcap", lambda p: write_file(p, b""), "truncated or damaged"),
        ("text.mcap", lambda p: write_file(p, b"text " * 100), "truncated or damaged"),
        ("old.mcap", lambda p: write_empty_mcap(p, "ros1"), "MCAP file with ROS 1 messages; give the .bag"),
        ("other.mcap", lambda p: write_empty_mcap(p, ""), "without ROS 2 messages (profile '')"),
        ("text.db3", lambda p: write_file(p, b"text " * 100), "truncated or damaged"),
        ("bag", lambda p: write_file(p / "metadata.yaml", "text"), "truncated or damaged"),
        ("bag", lambda p: write_file(p / "metadata.yaml", "a: [\n"), "truncated or damaged"),
    ],
)
def test_invalid_bag_is_reported_in_one_line(tmp_path, name, make, words):
    make(tmp_path / name)
    with pytest.raises(InputError) as error:
        Bag(tmp_path / name)
    assert str(tmp_path / name) in str(error.value) and words in str(error.value)
    assert "\n" not in str(error.value)


def test_bag_without_its_storage_file_is_damaged(sample_bag, tmp_path):
    shutil.copy(sample_bag / "metadata.yaml", tmp_path)
    with pytest.raises(InputError, match="truncated or damaged"):
        message_bytes(tmp_path)


@pytest.mark.parametrize("folder", [True, False])
@pytest.mark.no_cover
def test_truncated_bag_is_reported(sample_bag, tmp_path, folder):
    raw = (sample_bag / "drive.mcap").read_bytes()
    if folder:
        shutil.copy(sample_bag / "metadata.yaml", tmp_path)
    path = tmp_path / "drive.mcap"
    for size in [*range(0, len(raw), 9973), *range(len(raw) - 12, len(raw))]:
        path.write_bytes(raw[:size])
        with pytest.raises(InputError, match="truncated or damaged"):
            message_bytes(tmp_path if folder else path)


def read_unless_damaged(path):
    """Return the messages, or None if the bag is reported as damaged in one line."""
    try:
        with Bag(path) as bag:
            rows = list(bag.raw_messages())
            assert {t: sum(row[0] == t for row in rows) for t in bag.topics} == bag.counts
        return rows
    except InputError as error:
        assert "truncated or damaged" in str(error) and "\n" not in str(error)
        return None


DAMAGES = {
    "deleted": lambda raw, at: raw[:at] + raw[at + 1 :],
    "inserted": lambda raw, at: raw[:at] + b"\x91" + raw[at:],
    "flipped": lambda raw, at: raw[:at] + bytes([raw[at] ^ 1 << at % 8]) + raw[at + 1 :],
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
@pytest.mark.no_cover
def test_damaged_byte_is_reported_or_harmless(sample_bag, tmp_path, damage):
    """The damage is in the data, in a chunk header, or in the index."""
    raw, before = (sample_bag / "drive.mcap").read_bytes(), message_bytes(sample_bag)
    path, reported = tmp_path / "drive.mcap", 0
    with open(sample_bag / "drive.mcap", "rb") as stream:
        chunk = make_reader(stream).get_summary().chunk_indexes[0].chunk_start_offset
    offsets = [*range(8, len(raw), len(raw) // 40), *range(chunk, chunk + 60, 3), *range(len(raw) - 4000, len(raw), 41)]
    for at in offsets:
        path.write_bytes(damage(raw, at))
        rows = read_unless_damaged(path)
        assert rows in (None, before)
        reported += rows is None
    assert reported > 0.8 * len(offsets)


def test_index_without_checksum_is_compared_with_the_data(sample_bag, tmp_path):
    copy_bag(sample_bag, tmp_path / "plain", "mcap")
    source = tmp_path / "plain/plain.mcap"
    raw = source.read_bytes()
    with open(source, "rb") as stream:
        index = make_reader(stream).get_summary().chunk_indexes[0]
    at = raw.index(
        struct.pack(
            "<QQQQ", index.message_start_time, index.message_end_time, index.chunk_start_offset, index.chunk_length
        )
    )
    assert read_unless_damaged(source) == message_bytes(sample_bag)
    path = tmp_path / "drive.mcap"
    for byte in range(at, at + 32):
        path.write_bytes(DAMAGES["flipped"](raw, byte))
        assert read_unless_damaged(path) is None


def test_chunk_that_declares_terabytes_is_rejected(sample_bag, tmp_path):
    raw = bytearray((sample_bag / "drive.mcap").read_bytes())
    with open(sample_bag / "drive.mcap", "rb") as stream:
        at = make_reader(stream).get_summary().chunk_indexes[0].chunk_start_offset
    raw[at + 9 + 16 : at + 9 + 24] = struct.pack("<Q", 2**41)
    (tmp_path / "drive.mcap").write_bytes(raw)
    with pytest.raises(InputError, match="size of 2199023255552 bytes"):
        Bag(tmp_path / "drive.mcap")


def test_bag_without_clouds_lists_its_topics(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/text", "std_msgs/msg/String")
        bag.write("/text", 1, make_bag_message("std_msgs/msg/String", data="hello"))
    with pytest.raises(InputError) as error:
        open_recording(tmp_path / "bag")
    for word in (str(tmp_path / "bag"), "no sensor_msgs/PointCloud2", "/text (std_msgs/msg/String)", "driver"):
        assert word in str(error.value)


def test_unusable_cloud_does_not_affect_others(tmp_path):
    cloud = make_scene()[:, :2].copy().view([("x", "<f4"), ("y", "<f4")]).reshape(-1)
    write_bag(tmp_path / "bag", scans(1))
    with BagWriter(tmp_path / "mixed") as bag:
        bag.add_topic(POINTS, "sensor_msgs/msg/PointCloud2")
        bag.write(POINTS, 1, from_array(cloud, make_any_header(make_bag_message, 1), make_bag_message))
        for topic, _, data in message_bytes(tmp_path / "bag"):
            if topic == POINTS:
                bag.write(POINTS, 2, data)
    flat, good = open_recording(tmp_path / "mixed")
    with pytest.raises(InputError, match=r"mixed, topic /points at 1 ns: .*no field 'z'"):
        flat.load()
    assert same_cloud(make_scene(), good.load().xyz)
