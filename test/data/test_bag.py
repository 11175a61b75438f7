"""Reading and writing of bags."""

from __future__ import annotations

import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial

import lz4.frame
import numpy as np
import pytest
import yaml
import zstandard
from bag_samples import LATCHED, cloud_frame, message_bytes, same_cloud, scans
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from rosbags.highlevel import AnyReader
from samples import STAMP, make_png_header, make_scene, write_file

from lidar_perception.data.bag import Bag, BagWriter
from lidar_perception.data.bag_metadata import LATCHED_QOS
from lidar_perception.data.frame import Frame
from lidar_perception.data.open import open_recording
from lidar_perception.data.to_bag import write_bag
from lidar_perception.testing.bags import copy_bag
from lidar_perception.testing.clouds import make_cloud_message
from lidar_perception.types import GroundTruth, InputError
from lidar_perception.wire.codec import encode, make_bag_message
from lidar_perception.wire.compression import decompress
from lidar_perception.wire.topics import CAMERA_INFO, EXTRINSICS, IMAGE, POINTS, TRUTH
from msg_utils.point_cloud2 import to_array


def test_recording_returns_the_written_scans(sample_bag):
    recording = open_recording(sample_bag)
    assert len(recording) == 3
    for i, (scan, read) in enumerate(zip(scans(), recording, strict=True)):
        frame = read.load()
        assert same_cloud(make_scene(i), frame.xyz)
        assert np.array_equal(scan.load().intensity, frame.intensity)
        assert (frame.stamp_ns, frame.frame_id) == (scan.stamp_ns, "velodyne")
        assert (read.stamp_ns, read.name, read.index) == (scan.stamp_ns, str(scan.stamp_ns), i)
        truth, expected = read.truth(), scan.truth()
        assert (truth is None) == (expected is None)
        if expected is not None:
            np.testing.assert_allclose(truth.boxes, expected.boxes, atol=1e-12)
            assert truth.labels == expected.labels
        camera, expected = read.camera(), scan.camera()
        np.testing.assert_allclose(camera.projection, expected.projection, atol=1e-9)
        assert (camera.width, camera.height) == (expected.width, expected.height)


def test_clouds_are_stored_bit_by_bit(tmp_path):
    cloud = np.array([[1, 2, 3, 0.5], [np.nan, -0.0, np.inf, -1], [0, 0, 0, 0]], np.float32)
    write_bag(
        tmp_path / "bag", [Frame.of(str(i), cloud_frame(part, STAMP + i)) for i, part in enumerate((cloud, cloud[:0]))]
    )
    with Bag(tmp_path / "bag") as bag:
        full, empty = [to_array(msg) for _, _, msg in bag.messages({POINTS})]
    assert full.dtype.names == ("x", "y", "z", "intensity") and len(empty) == 0
    assert full.tobytes() == cloud.tobytes()


def test_missing_labels_camera_and_pose_are_not_written(tmp_path):
    write_bag(tmp_path / "bag", [Frame.of("0", cloud_frame(make_scene(), STAMP))])
    recording = open_recording(tmp_path / "bag")
    (read,) = recording
    assert read.truth() is None and read.camera() is None and read.pose() is None
    with Bag(tmp_path / "bag") as bag:
        assert {t for t, _, _ in bag.raw_messages()} == {POINTS}


def test_empty_labels_are_not_missing_labels(tmp_path):
    write_bag(tmp_path / "bag", [Frame.of("0", cloud_frame(make_scene(), STAMP), GroundTruth.of([], []))])
    (read,) = open_recording(tmp_path / "bag")
    assert len(read.truth()) == 0


def test_images_are_stored_byte_by_byte(tmp_path):
    image = write_file(tmp_path / "image.png", make_png_header(3, 2) + b"pixels")
    write_bag(tmp_path / "bag", [Frame.of("0", cloud_frame(make_scene(), STAMP), image=image)], images=True)
    with Bag(tmp_path / "bag") as bag:
        ((_, stamp, msg),) = bag.messages({IMAGE})
    assert (bytes(msg.data), msg.format, stamp) == (image.read_bytes(), "png", STAMP)


def test_calibration_is_written_before_its_cloud_when_it_changes(sample_bag):
    order = [(t, s) for t, s, _ in message_bytes(sample_bag)]
    for topic in LATCHED:
        assert [s for t, s in order if t == topic] == [STAMP, STAMP + 2 * 10**8]
    for stamp in (STAMP, STAMP + 2 * 10**8):
        assert order.index((CAMERA_INFO, stamp)) < order.index((POINTS, stamp))


def test_rosbags_reads_the_bag(sample_bag):
    with AnyReader([sample_bag]) as reader:
        got = [(c.topic, s, bytes(data)) for c, s, data in reader.messages()]
        types = {c.topic: c.msgtype for c in reader.connections}
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
    assert got == message_bytes(sample_bag)
    assert types[POINTS] == "sensor_msgs/msg/PointCloud2"


def test_mcap_reads_the_bag_and_verifies_its_checksums(sample_bag):
    with open(sample_bag / "drive.mcap", "rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        got = [
            (channel.topic, m.log_time, m.data, channel.message_encoding, schema.encoding)
            for schema, channel, m in reader.iter_messages(log_time_order=False)
        ]
        assert reader.get_header().profile == "ros2"
    assert sorted(got) == sorted((*row, "cdr", "ros2msg") for row in message_bytes(sample_bag))


def test_zstd_chunks_hold_several_clouds(tmp_path):
    cloud = np.random.default_rng(0).random((60_000, 4), np.float32)
    count = write_bag(tmp_path / "bag", (Frame.of(str(i), cloud_frame(cloud, STAMP + i)) for i in range(12)))
    with open(tmp_path / "bag/bag.mcap", "rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    assert {c.compression for c in chunks} == {"zstd"}
    assert 1 < len(chunks) < count / 2


@pytest.mark.parametrize(
    ("compression", "pack"),
    [("zstd", lambda data: zstandard.compress(data, level=1)), ("lz4", lz4.frame.compress), ("none", bytes)],
)
def test_bag_has_the_requested_compression(tmp_path, compression, pack):
    cloud = np.random.default_rng(0).normal(size=(2000, 4)).astype(np.float32)
    data = encode(make_cloud_message(cloud))
    with BagWriter(tmp_path / "bag", compression=compression) as bag:
        bag.add_topic(POINTS, "sensor_msgs/msg/PointCloud2")
        for i in range(3):
            bag.write(POINTS, STAMP + i, data)
    with open(tmp_path / "bag/bag.mcap", "rb") as stream:
        (chunk,) = (record for record in StreamReader(stream, emit_chunks=True).records if isinstance(record, Chunk))
    assert chunk.compression == compression.replace("none", "")
    assert chunk.data == pack(decompress(chunk.data, chunk.compression, None))
    with Bag(tmp_path / "bag") as bag:
        assert [raw for *_, raw in bag.raw_messages({POINTS})] == 3 * [data]


def test_calibrations_are_latched_and_clouds_are_not(sample_bag):
    with Bag(sample_bag) as bag:
        for topic in bag.topics:
            (quality,) = bag.find_qos(topic)
            latched = quality.durability.name == "TRANSIENT_LOCAL"
            assert latched == (topic in LATCHED)
            assert quality.reliability.name == "RELIABLE"
    with open(sample_bag / "drive.mcap", "rb") as stream:
        channels = make_reader(stream).get_summary().channels.values()
    for channel in channels:
        (quality,) = yaml.safe_load(channel.metadata["offered_qos_profiles"])
        assert (quality["durability"] == "transient_local") == (channel.topic in LATCHED)


def test_metadata_matches_the_file(sample_bag):
    info = yaml.safe_load((sample_bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    rows = message_bytes(sample_bag)
    counts = {t["topic_metadata"]["name"]: t["message_count"] for t in info["topics_with_message_count"]}
    assert counts == {topic: sum(t == topic for t, _, _ in rows) for topic in counts}
    assert counts[POINTS] == 3 and counts[TRUTH] == 2 and IMAGE not in counts
    assert info["message_count"] == len(rows)
    assert info["starting_time"]["nanoseconds_since_epoch"] == min(s for _, s, _ in rows)
    assert info["duration"]["nanoseconds"] == max(s for _, s, _ in rows) - STAMP
    assert info["relative_file_paths"] == ["drive.mcap"]
    with Bag(sample_bag) as bag:
        assert (bag.start_ns, bag.counts) == (STAMP, counts)


def test_bag_without_messages_has_no_frames(tmp_path):
    assert write_bag(tmp_path / "bag", []) == 0
    with pytest.raises(InputError, match=r"bag .* has no frames; record"):
        open_recording(tmp_path / "bag")


def load_bytes(frames, i):
    return frames[i].load().xyz.tobytes()


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_frames_can_be_loaded_in_any_order_thread_and_process(sample_bag, tmp_path, storage):
    """Each thread opens the bag only once, because reading the index of a long bag takes time."""
    copy_bag(sample_bag, tmp_path / "bag", storage)
    frames = open_recording(tmp_path / "bag").frames
    expected = [frame.load().xyz.tobytes() for frame in frames]
    order = [2, 0, 1] * 4

    def is_unchanged(i):
        return load_bytes(frames, i) == expected[i]

    with ThreadPoolExecutor(3) as pool:
        assert all(map(is_unchanged, order)) and all(pool.map(is_unchanged, order))
    with ProcessPoolExecutor(2, multiprocessing.get_context("fork")) as pool:
        assert list(pool.map(partial(load_bytes, frames), order)) == [expected[i] for i in order]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Bag, "__init__", None)
        assert all(map(is_unchanged, order))


def test_raw_messages_are_selected_by_topic_and_time(sample_bag):
    rows = message_bytes(sample_bag)
    with Bag(sample_bag) as bag:
        topics = {POINTS, TRUTH}
        assert list(bag.raw_messages(topics)) == [row for row in rows if row[0] in topics]
        assert list(bag.raw_messages(set())) == []
        low, high = STAMP + 1, STAMP + 2 * 10**8
        assert list(bag.raw_messages(None, low, high)) == [r for r in rows if low <= r[1] < high]


@pytest.mark.parametrize("reverse", [False, True])
def test_messages_without_chunks_are_read_one_by_one(sample_bag, tmp_path, monkeypatch, reverse):
    """The preset fastwrite of `ros2 bag record` writes no chunks."""
    path, rows = tmp_path / "fast.mcap", message_bytes(sample_bag)
    last = max(time for _, time, _ in rows)
    with open(sample_bag / "drive.mcap", "rb") as stream, open(path, "wb") as out:
        writer, channels = Writer(out, use_chunking=False, enable_crcs=False), {}
        writer.start("ros2")
        found = list(make_reader(stream).iter_messages())
        for schema, channel, message in sorted(found, key=lambda row: row[2].log_time, reverse=reverse):
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number, channel.metadata
                )
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    assert message_bytes(path) == rows
    read, pread = [], os.pread
    monkeypatch.setattr(os, "pread", lambda file, size, at: read.append(size) or pread(file, size, at))
    with Bag(path) as bag:
        list(bag.raw_messages())
        read.clear()
        _, _, data = next(bag.raw_messages({POINTS}, last, last + 1))
    assert read == [len(data)]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_files_of_a_split_bag_are_read_in_time_order(tmp_path, storage):
    parts = []
    for name, stamps in (("late", (30, 40)), ("early", (10, 20))):
        with BagWriter(tmp_path / f"{name}_ours") as bag:
            bag.add_topic("/text", "std_msgs/msg/String")
            for stamp in stamps:
                bag.write("/text", stamp, make_bag_message("std_msgs/msg/String", data=str(stamp)))
        parts.append(copy_bag(tmp_path / f"{name}_ours", tmp_path / name, storage))
    metadata = yaml.safe_load((parts[0] / "metadata.yaml").read_text())
    info = metadata["rosbag2_bagfile_information"]
    for file in [f for f in parts[1].iterdir() if f.suffix != ".yaml"]:
        info["relative_file_paths"].append(file.rename(parts[0] / file.name).name)
    info["topics_with_message_count"][0]["message_count"] = info["message_count"] = 4
    info.update(starting_time={"nanoseconds_since_epoch": 10}, duration={"nanoseconds": 30})
    (parts[0] / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    assert [stamp for _, stamp, _ in message_bytes(parts[0])] == [10, 20, 30, 40]


def test_labels_may_come_after_their_cloud(sample_bag, tmp_path):
    with BagWriter(tmp_path / "late") as bag:
        bag.add_topic(POINTS, "sensor_msgs/msg/PointCloud2")
        bag.add_topic(TRUTH, "visualization_msgs/msg/MarkerArray")
        bag.add_topic(CAMERA_INFO, "sensor_msgs/msg/CameraInfo", LATCHED_QOS)
        bag.add_topic(EXTRINSICS, "geometry_msgs/msg/TransformStamped", LATCHED_QOS)
        for topic, stamp, data in message_bytes(sample_bag):
            if topic in bag.channels:
                bag.write(topic, stamp + (topic != POINTS) * 5 * 10**7, data)
    read = list(open_recording(tmp_path / "late"))
    assert [r.truth() is not None for r in read] == [True, False, True]
    assert all(r.camera() is not None for r in read)
