"""Frames of a bag, and bags converted from any recording."""

from __future__ import annotations

import os
import shutil

import numpy as np
import pytest
from bag_samples import cloud_frame, message_bytes, same_cloud, scans
from recording_samples import MADE, each_recording
from samples import STAMP, make_any_header, make_scene, make_walker_truth, write_file, write_object_folder

from lidar_perception.data import bag_frames
from lidar_perception.data.bag import Bag, BagWriter
from lidar_perception.data.frame import CAMERA, Frame, split_drives
from lidar_perception.data.open import open_recording
from lidar_perception.data.to_bag import to_point_array, write_bag
from lidar_perception.types import InputError
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.messages import make_truth_markers
from lidar_perception.wire.topics import CAMERA_INFO, POINTS, TRUTH
from msg_utils.point_cloud2 import from_array


def are_equal_frames(a, b):
    return (a.name, a.stamp_ns, a.index) == (b.name, b.stamp_ns, b.index) and np.array_equal(a.load().xyz, b.load().xyz)


def test_indexed_frames_equal_iterated_frames(sample_bag, tmp_path):
    clouds = [row for row in message_bytes(sample_bag) if row[0] == POINTS]
    with BagWriter(tmp_path / "equal") as bag:  # three with the same time, two with the same stamp
        bag.add_topic(POINTS, "sensor_msgs/msg/PointCloud2")
        bag.add_topic("/other", "sensor_msgs/msg/PointCloud2")
        for i, time in ((2, 5), (0, 7), (1, 7), (0, 7), (2, 9)):
            bag.write("/other", time, clouds[1][2])
            bag.write(POINTS, time, clouds[i][2])
    for path, count in ((sample_bag, 3), (tmp_path / "equal", 5)):
        recording = open_recording(path)
        frames = list(recording)
        assert len(frames) == len(recording) == count == len({f.name for f in frames})
        for i, frame in enumerate(frames):
            assert are_equal_frames(frame, recording.frames[i])
            assert are_equal_frames(frame, recording.frames[i - count])
            assert (frame.truth() is None) == (recording.frames[i].truth() is None)
        assert [f.name for f in recording.frames[1:]] == [f.name for f in frames[1:]]
        for i in (count, -count - 1):
            with pytest.raises(IndexError):
                recording.frames[i]
    assert [find_scene(f) for f in frames] == [2, 0, 1, 0, 2]


def find_scene(frame):
    return next(i for i in range(3) if same_cloud(make_scene(i), frame.load().xyz))


def test_cloud_topic_is_chosen_or_the_available_ones_are_listed(tmp_path):
    scan = bytes(8)
    for name, topics in {"two": ["/a", "/b"], "default": ["/a", POINTS], "one": ["/a"]}.items():
        with BagWriter(tmp_path / name) as bag:
            for topic in [*topics, "/empty"]:
                bag.add_topic(topic, "sensor_msgs/msg/PointCloud2")
            for topic in topics:
                bag.write(topic, STAMP, scan)
    for name, points, expected in [("two", "/b", "/b"), ("default", "", POINTS), ("one", "", "/a")]:
        with Bag(tmp_path / name) as bag:
            assert bag_frames.choose_cloud_topic(bag, points) == expected
    for name, points, words in [("two", "", "clouds on /a, /b; choose a topic, as in points:=/a"), ("one", "/c", "/c")]:
        with Bag(tmp_path / name) as bag, pytest.raises(InputError, match=words):
            bag_frames.choose_cloud_topic(bag, points, "points:={topic}")


def test_first_frame_is_read_without_scanning_the_bag(sample_bag, monkeypatch):
    """Scanning an hour of clouds takes minutes, and many commands need only the first one."""
    stamped = []
    monkeypatch.setattr(bag_frames.BagFrames, "_find_stamp", lambda self, data, time: stamped.append(time) or time)
    frames = open_recording(sample_bag).frames
    assert frames[0].index == frames[-3].index == 0 and len({*stamped}) == 1
    assert frames[1].index == 1 and len({*stamped}) == 3


def test_indexed_frame_is_read_on_load(sample_bag, tmp_path):
    shutil.copytree(sample_bag, tmp_path / "bag")
    frame = open_recording(tmp_path / "bag").frames[1]
    os.truncate(tmp_path / "bag/drive.mcap", 100)
    with pytest.raises(InputError, match="is truncated or damaged"):
        frame.load()


def test_contents_lists_only_recorded_content(tmp_path):
    write_bag(tmp_path / "bag", [Frame.of("0", cloud_frame(make_scene(), STAMP))])
    assert open_recording(tmp_path / "bag").contents == set()


@each_recording
def test_converted_bag_equals_the_recording(tmp_path, kind):
    recording = open_recording(MADE[kind][0](tmp_path / kind))
    assert write_bag(tmp_path / "made", recording) == len(recording)
    bag = open_recording(tmp_path / "made")
    assert bag.contents == recording.contents
    for frame, read in zip(recording, bag, strict=True):
        expected, got = frame.load(), read.load()
        assert np.array_equal(got.xyz, expected.xyz)
        assert np.array_equal(got.intensity, expected.intensity)
        assert got.stamp_ns == expected.stamp_ns
        pose, read_pose = frame.pose(), read.pose()
        assert (pose is None) == (read_pose is None)
        if pose is not None:
            np.testing.assert_allclose(read_pose, pose, atol=1e-6)
        labels, read_pose = frame.point_truth(), read.point_truth()
        assert (labels is None) == (read_pose is None)
        if labels is not None:
            assert np.array_equal(read_pose.classes, labels.classes)
            assert np.array_equal(read_pose.instances, labels.instances)
        truth, read_pose = frame.truth(), read.truth()
        assert (truth is None) == (read_pose is None)
        if truth is not None:
            np.testing.assert_allclose(read_pose.boxes, truth.boxes, atol=1e-9)
            assert read_pose.labels == truth.labels and len(read_pose.notes) == len(truth.notes)
            for a, b in zip(read_pose.extras, truth.extras, strict=True):
                assert a.keys() == b.keys()
                np.testing.assert_equal([a.get("track_id"), a.get("category")], [b.get("track_id"), b.get("category")])
    with Bag(tmp_path / "made") as converted:  # the calibration is written when it changes
        assert converted.counts[CAMERA_INFO] == (CAMERA in recording.contents) * (1 + (kind == "bag"))


def test_unreadable_scan_is_skipped_and_reported(tmp_path):
    root = write_object_folder(tmp_path / "kitti", count=3)
    write_file(root / "training/velodyne/000001.bin", b"cut")
    with pytest.raises(InputError, match=r"000001\.bin"):
        write_bag(tmp_path / "strict", open_recording(root))
    skipped = []
    assert write_bag(tmp_path / "bag", open_recording(root), skipped=skipped) == 2
    assert len(skipped) == 1 and "000001.bin" in skipped[0]
    assert [find_scene(f) for f in open_recording(tmp_path / "bag")] == [0, 2]


def test_scan_with_negative_stamp_is_skipped_and_reported(tmp_path):
    scans, skipped = [Frame.of(str(t), cloud_frame(make_scene(), t)) for t in (-5, 7)], []
    assert write_bag(tmp_path / "bag", scans, skipped=skipped) == 1
    assert "-5" in skipped[0] and open_recording(tmp_path / "bag").frames[0].stamp_ns == 7


@pytest.mark.parametrize(
    "stamps, expected",
    [([0, 1, 2], [0, 1, 2]), ([0, 0, 2], [0, 0, 2]), ([5, 0, 2], [5, 0, 2]), ([0, 0], [70, 71]), ([0], [70])],
)
def test_zero_stamps_are_replaced_only_if_all_are_zero(tmp_path, stamps, expected):
    """Simulated time starts at 0. Drivers that set no stamps leave all of them at 0."""
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic(POINTS, "sensor_msgs/msg/PointCloud2")
        bag.add_topic(TRUTH, "visualization_msgs/msg/MarkerArray")
        for i, stamp in enumerate(stamps):
            head = make_any_header(make_bag_message, stamp)
            points = to_point_array(scans(1)[0].load())
            bag.write(POINTS, 70 + i, from_array(points, head, make_bag_message))
            bag.write(TRUTH, 70 + i, make_truth_markers(make_walker_truth(), head, make_bag_message))
    recording = open_recording(tmp_path / "bag")
    assert [frame.stamp_ns for frame in recording] == expected
    assert [frame.stamp_ns for frame in recording.frames[:]] == expected
    assert all(frame.truth() is not None for frame in recording)
    assert len(split_drives(recording.frames)[""]) == (1 if expected == sorted(expected) else 2)
