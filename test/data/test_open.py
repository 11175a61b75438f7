"""Opening of recordings in all layouts, and split files."""

from __future__ import annotations

import os
from itertools import pairwise

import numpy as np
import nuscenes_folder
import pytest
from bag_samples import cloud_frame
from recording_samples import MADE, cloud_folder, each_recording, make_drive_pose, nuscenes_root, semantic_folder
from samples import STAMP, make_scene, write_file, write_object_folder

from lidar_perception.cli.data import open_and_describe
from lidar_perception.data.bag import Bag, BagWriter
from lidar_perception.data.frame import BOXES, CAMERA, POINT_LABELS, POSES, Frame
from lidar_perception.data.kitti.folder import GAP_NS, PERIOD_NS, read_velodyne
from lidar_perception.data.open import open_recording
from lidar_perception.data.raw_clouds import open_clouds
from lidar_perception.data.semantickitti import write_scan
from lidar_perception.data.to_bag import write_bag
from lidar_perception.types import SENSOR_HEIGHT, InputError, PointCloud
from lidar_perception.wire.codec import make_bag_message
from msg_utils.point_cloud2 import from_array
from msg_utils.stamps import make_header


@each_recording
def test_layouts_are_recognised_and_read(tmp_path, monkeypatch, kind):
    make, inner, description, has = MADE[kind]
    root = make(tmp_path / kind)
    names = [frame.name for frame in open_recording(root)]
    assert len(set(names)) == len(names)
    for part in inner:
        recording = open_recording(root / part)
        assert str(recording) == ", ".join([f"{root / part}: {description}", *sorted(has)])
        assert recording.contents == has and [frame.name for frame in recording] == names
        for frame, reopened in zip(recording, recording.reopen().frames, strict=True):
            assert (frame.name, frame.stamp_ns) == (reopened.name, reopened.stamp_ns)
            assert len(frame.load()) and np.array_equal(frame.load().xyz, reopened.load().xyz)
            assert frame.load().stamp_ns == frame.stamp_ns
            assert (frame.camera() is not None) == (CAMERA in has)
            assert type(frame.calibration().width) is int if CAMERA in has else True
            assert (frame.pose() is not None) == (POSES in has)
            assert (frame.point_truth() is not None) == (POINT_LABELS in has)
            assert bool(frame.files) == (BOXES in has)
            assert frame.truth() is None or all(file.is_file() for file in frame.files)
        assert any(frame.truth() is not None for frame in recording) == (BOXES in has)
        if (root / part).is_dir():
            monkeypatch.chdir(root / part)
            assert [frame.name for frame in open_recording(".")] == names
    for content in (BOXES, POINT_LABELS, CAMERA, POSES):
        if content in has:
            recording.require(content, "evaluate")
        else:
            with pytest.raises(InputError, match=r"has no .*, which evaluate needs") as error:
                recording.require(content, "evaluate")
            assert content.removeprefix("a ") in str(error.value)
            assert description.split(",")[0] in str(error.value)
    for a, b in pairwise(recording):
        assert a.stamp_ns < b.stamp_ns or a.sequence != b.sequence
        assert a.index < b.index or a.sequence != b.sequence


def test_semantickitti_sequence_is_a_recording(tmp_path):
    root = semantic_folder(tmp_path)
    assert [f.name for f in open_recording(root / "sequences/08")] == ["08/000000"]
    (root / "sequences").rename(root / "inner")
    (root / "dataset").mkdir()
    (root / "inner").rename(root / "dataset/sequences")
    assert len(open_recording(root)) == 3


def test_cloud_files_are_ordered_and_stamped_by_name(tmp_path):
    folder = cloud_folder(tmp_path / "counted")
    assert [f.name for f in open_recording(folder)] == ["scan1", "scan2", "scan10"]
    assert [f.name for f in open_recording(folder / "scan10.bin")] == ["scan10"]
    for names in (
        ["1700000000.1", "1700000000.35"],
        ["1700000000100", "1700000000350"],
        ["1700000000100000", "1700000000350000"],
        ["1700000000100000000", "1700000000350000000"],
    ):
        timed = tmp_path / names[0]
        for name in names:
            write_file(timed / f"{name}.bin", make_scene(0).astype(np.float32).tobytes())
        recording = open_recording(timed)
        assert [f.stamp_ns - 17 * 10**17 for f in recording] == [10**8, 35 * 10**7]
        assert [f.load().stamp_ns for f in recording] == [f.stamp_ns for f in recording]
        write_file(timed / "last.bin", make_scene(0).astype(np.float32).tobytes())
        assert "no times" in str(open_recording(timed))


def test_cloud_topic_of_a_bag_is_inferred_or_given(tmp_path):
    def write_clouds(name, *topics):
        with BagWriter(tmp_path / name) as writer:
            for topic in topics:
                writer.add_topic(topic, "sensor_msgs/msg/PointCloud2")
                for i in range(2):
                    writer.write(
                        topic,
                        STAMP + i,
                        from_array(
                            make_scene(i).astype("<f4").view([(n, "<f4") for n in "xyzi"]).ravel(),
                            make_header(STAMP + i, "lidar", make_bag_message),
                            make_bag_message,
                        ),
                    )
        return tmp_path / name

    assert "on /ouster/points, 2" in str(open_recording(write_clouds("one", "/ouster/points")))
    assert "on /points, 2" in str(open_recording(write_clouds("ours", "/ouster/points", "/points")))
    both = write_clouds("both", "/front", "/rear")
    with pytest.raises(InputError, match=r"clouds on /front, /rear; choose .*both:/front$"):
        open_recording(both)
    for recording in (open_recording(f"{both}:/rear"), open_recording(both, points="/rear")):
        assert "on /rear, 2" in str(recording) and len(recording.reopen()) == 2
    assert "on /rear" in open_clouds(f"{both}:/rear").layout
    with pytest.raises(InputError, match="has no topic /side"):
        open_recording(f"{both}:/side")


@pytest.mark.parametrize("height, expected", [(0.6, 0.6), (1.8, SENSOR_HEIGHT)])
def test_commands_measure_the_sensor_height_if_unknown(tmp_path, height, expected):
    rng = np.random.default_rng(0)
    ground = rng.uniform([-20, -20, -0.02], [20, 20, 0.02], (9000, 3)) - [0, 0, height]
    cloud = np.column_stack([ground, np.ones(len(ground))]).astype(np.float32)
    write_bag(tmp_path / "bag", [Frame.of(str(i), cloud_frame(cloud, STAMP + i * 10**8)) for i in range(4)])
    write_file(tmp_path / "files/0.bin", cloud.tobytes())
    for path in (tmp_path / "bag", tmp_path / "files"):
        recording = open_and_describe(path)
        for frames in (recording.frames, recording.reopen().frames):
            heights = [f.sensor_height for f in (*frames, frames[0], *frames[-1:])]
            assert heights == pytest.approx([expected] * len(heights), abs=0.02)
        assert {f.sensor_height for f in open_recording(path)} == {SENSOR_HEIGHT}
        assert {f.sensor_height for f in open_recording(path, sensor_height=3.0)} == {3.0}


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda p: p / "missing", "missing does not exist; give a bag or the folder of a data set"),
        (lambda p: p, "in a supported format: expected a rosbag2 bag, or the folder of KITTI"),
        (lambda p: write_file(p / "notes.txt", b"text"), "not a bag; give the folder of a rosbag2 bag"),
        (lambda p: write_file(p / "training/velodyne/x", b"").parents[2], "has no KITTI scans: expected"),
        (
            lambda p: write_file(p / "sequences/00/x", b"").parents[2],
            "no scans of KITTI odometry or SemanticKITTI: expected",
        ),
        (
            lambda p: nuscenes_folder.save(nuscenes_root(p), nuscenes_folder.make_tables(), "v1.0-test", False),
            "several versions; choose one of .*v1.0-test",
        ),
    ],
)
def test_invalid_recording_is_reported_with_remedy(tmp_path, make, words):
    with pytest.raises(InputError, match=words) as error:
        open_recording(make(tmp_path))
    assert "\n" not in str(error.value) and str(tmp_path) in str(error.value)


def test_labels_without_scan_are_listed(tmp_path):
    root = write_object_folder(tmp_path, count=3)
    (root / "training/velodyne/000001.bin").unlink()
    recording = open_recording(root)
    assert [f.name for f in recording] == ["000000", "000002"]
    ((name, reason),) = recording.missing_scans
    assert name == "000001" and "000001.txt has no scan; download it again" in reason
    labels_only = open_recording(root, scans=False)
    assert len(labels_only) == 3 and labels_only.missing_scans == ()


# splits


@each_recording
def test_split_selects_each_frame_once_in_its_order(tmp_path, kind):
    root = MADE[kind][0](tmp_path / kind)
    names = [frame.name for frame in open_recording(root)]
    requested = [names[-1], names[0], names[-1]]
    recording = open_recording(root, split=write_file(tmp_path / "split.txt", "\n".join(requested)))
    assert [f.name for f in recording] == [f.name for f in recording.reopen()] == requested[:2]
    assert len(recording.frames[0].load()) and str(recording).count("2 frames") == 1
    whole = open_recording(root)
    assert [f.name for f in whole.select(names[::-1])] == names[::-1]
    with pytest.raises(InputError, match=rf"no frame x \(1 unknown names in all\); names there look like {names[0]}"):
        whole.select([names[0], "x"])


@pytest.mark.parametrize(
    "kind, sequences",
    [("tracking", ("0007", "0000")), ("nuscenes", nuscenes_folder.SCENES[::-1]), ("semantickitti", ("08", "00"))],
)
def test_split_accepts_names_of_sequences(tmp_path, kind, sequences):
    root = MADE[kind][0](tmp_path / kind)
    frames = list(open_recording(root))
    first, second = ([f.name for f in frames if f.sequence == name] for name in sequences)
    for requested, expected in (
        (sequences[:1], first),
        (sequences, first + second),
        ((first[-1], *sequences), first[-1:] + first[:-1] + second),
    ):
        split = write_file(tmp_path / "split.txt", "\n".join(requested) + "\n")
        assert [f.name for f in open_recording(root, split=split)] == expected


@pytest.mark.no_cover
def test_invalid_split_is_reported(tmp_path, sample_bag):
    for root in (write_object_folder(tmp_path / "kitti"), sample_bag):
        first = next(iter(open_recording(root))).name
        for text, words in (
            ("", f"is empty; write the name of a frame or sequence on each line, such as {first}"),
            (f"{first}\nx\ny\n", rf"such as x \(2 in all\); names there look like {first}"),
            (b"\xff\xfe\x00", "cannot read the split"),
        ):
            with pytest.raises(InputError, match=words) as error:
                open_recording(root, split=write_file(tmp_path / "split.txt", text))
            assert "\n" not in str(error.value) and "split.txt" in str(error.value)
        with pytest.raises(InputError, match="cannot read the split"):
            open_recording(root, split=tmp_path / "missing.txt")


# columns


def test_unusable_returns_are_dropped_from_all_columns(tmp_path):
    xyz = make_scene().astype(np.float64)[:, :3]
    intensity = np.arange(len(xyz), dtype=np.float32)
    bad = {3: np.nan, 10: np.inf, 11: -np.inf, 20: 0.0, 21: 1e6}
    for index, value in bad.items():
        xyz[index] = value
    usable = np.setdiff1d(np.arange(len(xyz)), list(bad))
    before = xyz.copy(), intensity.copy()
    frame = PointCloud.of(xyz, intensity, 5, "velodyne")
    assert np.array_equal(frame.xyz, xyz[usable].astype(np.float32))
    assert np.array_equal(frame.intensity, usable) and (frame.stamp_ns, frame.frame_id) == (5, "velodyne")
    assert frame.xyz.dtype == np.float32 and frame.xyz.flags.c_contiguous
    assert np.array_equal(before[0], xyz, equal_nan=True) and np.array_equal(before[1], intensity)
    assert PointCloud.of(xyz).intensity is None and len(PointCloud.of(xyz[:0])) == 0
    unit = intensity / np.float32(len(xyz))
    write_scan(tmp_path / "sequences/00", 0, np.column_stack([xyz, unit]), np.arange(len(xyz)), np.arange(len(xyz)))
    (read,) = open_recording(tmp_path)
    assert np.array_equal(read.load().intensity, unit[read.point_truth().classes])
    assert np.array_equal(read.point_truth().instances, usable)


def test_semantickitti_poses_are_read_unchanged(tmp_path):
    frames = open_recording(semantic_folder(tmp_path)).frames
    for frame in frames:
        np.testing.assert_allclose(frame.pose(), make_drive_pose(int(frame.points.stem)), atol=1e-9)
    stamps = [frame.stamp_ns for frame in frames]
    assert np.diff(stamps).tolist() == [PERIOD_NS, GAP_NS]  # a gap separates drives
    frames[0].points.unlink()
    assert [f.index for f in open_recording(tmp_path)] == [1, 0]
    np.testing.assert_allclose(open_recording(tmp_path).frames[0].pose(), make_drive_pose(1), atol=1e-9)
    frames[0].points.write_bytes(b"")
    (tmp_path / "sequences/00/poses.txt").write_text("1 0 0\n")
    with pytest.raises(InputError, match=r"cannot read pose 0 of .*poses.txt .*download it again"):
        open_recording(tmp_path).frames[0].pose()
    (tmp_path / "sequences/08/calib.txt").write_text("")
    with pytest.raises(InputError, match=r"calib.txt has no Tr"):
        open_recording(tmp_path).frames[-1].pose()


def test_named_pipe_is_rejected_without_blocking(tmp_path):
    (tmp_path / "bag").mkdir()
    for path in ("bag/bag.mcap", "pipe.bin"):
        os.mkfifo(tmp_path / path)
    for read in (
        lambda: open_recording(tmp_path / "bag"),
        lambda: Bag(tmp_path / "bag/bag.mcap"),
        lambda: read_velodyne(tmp_path / "pipe.bin"),
    ):
        with pytest.raises(InputError, match="is not a regular file"):
            read()
