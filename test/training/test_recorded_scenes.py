"""Recordings as sources of scenes: broken files, splits, cache keys and sensor heights."""

from __future__ import annotations

import os
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from detection_samples import make_tiny_config, make_two_objects
from hypothesis import given
from hypothesis import strategies as st
from samples import WALKER, make_walker_label, make_walker_truth, write_file, write_object_folder
from training_toy import STILL, broken_folder, prepare_all

from lidar_perception.data.frame import Frame
from lidar_perception.data.open import open_recording
from lidar_perception.data.to_bag import write_bag
from lidar_perception.geometry import points_in_box
from lidar_perception.training.data import Batches, Stream
from lidar_perception.training.frames import draw_drives, draw_items, open_labelled_frames
from lidar_perception.training.pointpillars.task import ScenePreparation
from lidar_perception.training.scenes import RecordedScenes
from lidar_perception.types import PEDESTRIAN, SENSOR_HEIGHT, GroundTruth, InputError, PointCloud

seeds = st.integers(0, 2**32 - 1)


def test_broken_scenes_are_skipped_reported_and_counted(tmp_path, capsys):
    root = broken_folder(tmp_path)
    stream = Stream((open_labelled_frames(root).to_scenes(),), prepare_all)
    batches = Batches(stream, 5)
    steps = batches(0)
    for _ in range(2):
        assert len(next(steps)) == 5
    assert len(batches.skipped) == 2
    reasons = sorted(batches.skipped)
    assert "000001.txt:1" in reasons[0] and "000003.bin" in reasons[1]
    assert capsys.readouterr().err.replace("\n", "").count("skipped:") == 2  # each problem is printed once
    broken = Stream((RecordedScenes(root, ("000001", "000003")),), prepare_all)
    with pytest.raises(InputError, match="no usable scene among 2"):
        broken[0]


def test_frame_without_labels_is_rejected(tmp_path):
    root = write_object_folder(tmp_path, count=2)
    (root / "training/label_2/000001.txt").unlink()
    with pytest.raises(InputError, match=r"000001\.bin has no labels"):
        RecordedScenes(root, ("000001",)).load_scene(0)


def test_kitti_scenes_are_cropped_to_the_image(tmp_path):
    root = write_object_folder(tmp_path, make_walker_label() + "\n", 1)
    ahead, whole = (RecordedScenes(root, ("000000",), view).load_scene(0) for view in (True, False))
    assert 0 < len(ahead.points) < len(whole.points)
    assert (ahead.points[:, 0] > 0).all() and (whole.points[:, 0] < 0).any()
    np.testing.assert_allclose(ahead.boxes[0], WALKER, atol=0.02)
    assert points_in_box(ahead.points[:, :3], ahead.boxes[0]).sum() > 300


def test_bag_of_folder_has_same_scenes(tmp_path):
    folder = write_object_folder(tmp_path / "kitti", make_walker_label() + "\n", 2)
    write_bag(tmp_path / "bag", open_recording(folder))
    from_bag = open_labelled_frames(tmp_path / "bag").to_scenes()
    from_bag.load_scene(0)  # opens files, which cannot be pickled
    for source in (from_bag, pickle.loads(pickle.dumps(from_bag))):
        for i in range(2):
            scene, expected = source.load_scene(i), open_labelled_frames(folder).to_scenes().load_scene(i)
            assert np.array_equal(scene.points, expected.points) and not scene.all_around
            np.testing.assert_allclose(scene.boxes, expected.boxes, atol=1e-9)
            assert np.array_equal(scene.class_ids, expected.class_ids)


def test_scenes_without_camera_are_labelled_all_around(tmp_path):
    frames = [Frame.of("0", PointCloud(make_two_objects()[:, :3].copy()), GroundTruth.of([WALKER], [PEDESTRIAN]))]
    write_bag(tmp_path / "bag", frames)
    scene = open_labelled_frames(tmp_path / "bag").to_scenes().load_scene(0)
    assert scene.all_around and np.array_equal(scene.points[:, :3], make_two_objects()[:, :3])
    assert not scene.points[:, 3].any()  # no intensity
    write_bag(tmp_path / "bare", [Frame.of("0", frames[0].load())])
    with pytest.raises(InputError, match="has no labelled boxes, which train needs"):
        open_labelled_frames(tmp_path / "bare")


def test_split_file_selects_frames(tmp_path):
    root = write_object_folder(tmp_path, count=4)
    split = write_file(tmp_path / "train.txt", "000003\n000001\n")
    assert open_labelled_frames(root, split).to_scenes().names == ("000003", "000001")
    assert len(open_labelled_frames(root).frames) == 4
    for text, reason in (("000009", "000009"), ("", "is empty")):
        with pytest.raises(InputError, match=reason):
            open_labelled_frames(root, write_file(split, text))
    with pytest.raises(InputError, match="cannot read the split"):
        open_labelled_frames(root, tmp_path / "missing.txt")


@given(st.lists(st.integers(1, 60), min_size=1, max_size=8).filter(lambda n: sum(n) > 1), st.floats(0, 1), seeds)
def test_held_out_frames_are_whole_drives_and_one_end(lengths, share, seed):
    ends = np.cumsum(lengths)
    drives = [range(end - length, end) for end, length in zip(ends, lengths)]
    for draw, items in (draw_items, range(ends[-1])), (draw_drives, drives):
        held_out = draw(items, share, seed)
        assert held_out == draw(items, share, seed) and len(set(held_out)) == len(held_out)
        assert 0 < len(held_out) < ends[-1] and abs(len(held_out) - share * ends[-1]) <= 1
    pieces = [sorted(set(held_out) & set(drive)) for drive in drives]  # see draw_drives
    cut = [(piece, drive) for piece, drive in zip(pieces, drives) if 0 < len(piece) < len(drive)]
    assert len(cut) <= 1 and all(piece == [*drive[-len(piece) :]] for piece, drive in cut)


def test_one_frame_cannot_be_split():
    for draw, items in (draw_items, ["000000"]), (draw_drives, [["000000"]]):
        with pytest.raises(InputError, match="--val"):
            draw(items, 0.5, 0)


def test_labelled_end_of_a_drive_is_held_out(tmp_path):
    frames = [
        Frame.of(
            str(i),
            replace(PointCloud(make_two_objects()[:, :3].copy()), stamp_ns=i * 10**8),
            make_walker_truth() if i < 8 else None,
        )
        for i in range(10)
    ]
    write_bag(tmp_path / "bag", frames)
    training, held_out = open_labelled_frames(tmp_path / "bag").split(0.25, 0)
    assert [frame.stamp_ns // 10**8 for frame in held_out.frames] == [6, 7]
    assert len(training.frames) == 8


def test_cache_key_changes_with_files_and_height(tmp_path, monkeypatch):
    root = write_object_folder(tmp_path / "kitti", make_walker_label() + "\n", 2)
    keys = [open_labelled_frames(root).to_scenes().cache_key(i) for i in range(2)]
    monkeypatch.chdir(tmp_path)
    assert open_labelled_frames(Path("kitti/training")).to_scenes().cache_key(0) == keys[0] != keys[1]
    write_file(root / "training/label_2/000000.txt", "")
    now = open_labelled_frames(root).to_scenes()
    assert now.cache_key(0) != keys[0] and now.cache_key(1) == keys[1]
    assert open_labelled_frames(root, height=0.6).to_scenes().cache_key(1) != keys[1]
    write_bag(tmp_path / "bag", open_recording(root))
    key = open_labelled_frames(tmp_path / "bag").to_scenes().cache_key(0)
    os.utime(next((tmp_path / "bag").glob("*.mcap")), ns=(0, 0))
    assert open_labelled_frames(tmp_path / "bag").to_scenes().cache_key(0) != key


def low_bag(path: Path, height: float, count: int = 2) -> Path:
    """Write a bag with level ground `height` metres below the sensor, and a person on it."""
    rng = np.random.default_rng(0)
    ground = rng.uniform(-20, 20, (6000, 3)) * [1, 1, 5e-4] - [0, 0, height]
    person = rng.uniform(-0.25, 0.25, (300, 3)) * [1, 1, 3.4] + [8, 0.5, 0.85 - height]
    xyz = np.concatenate([ground, person]).astype(np.float32)
    truth = GroundTruth.of([[8, 0.5, 0.85 - height, 0.6, 0.6, 1.7, 0]], [PEDESTRIAN])
    write_bag(
        path,
        [Frame.of(str(i), PointCloud(xyz, np.full(len(xyz), 0.3, np.float32), i * 10**8), truth) for i in range(count)],
    )
    return path


def test_samples_do_not_depend_on_sensor_height(tmp_path):
    config, samples = make_tiny_config(), []
    for height in SENSOR_HEIGHT, 0.6:
        source = open_labelled_frames(low_bag(tmp_path / f"{height}", height)).to_scenes()
        copied_source = pickle.loads(pickle.dumps(source))
        assert (
            copied_source.sensor_height
            == copied_source.load_scene(0).height
            == copied_source.load_frame(1).sensor_height
        )
        assert copied_source.sensor_height == pytest.approx(height, abs=0.011)
        samples.append(ScenePreparation(config, STILL)(source.load_scene(0), np.random.default_rng(0)))
    assert len(samples[0].points) == len(samples[1].points)
    assert np.allclose(samples[0].boxes, samples[1].boxes, atol=0.011)
    path = tmp_path / "0.6"
    assert open_labelled_frames(path, height=1.1, with_simulated=True).to_scenes().load_scene(0).height == 1.1
    folder = write_object_folder(tmp_path / "kitti", make_walker_label() + "\n", 1)
    assert open_labelled_frames(folder, height=1.1).to_scenes().load_scene(0).height == 1.1
    scenes = open_labelled_frames(folder, height=1.1, with_simulated=True).to_scenes()
    assert scenes.load_scene(0).height == SENSOR_HEIGHT
