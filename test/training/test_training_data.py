"""Data for training: simulated sources, the stream, samples and validation."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from detection_samples import BOXES, make_anchor_tensors, make_tiny_config, make_two_objects
from samples import WALKER
from training_toy import STILL, broken_folder, prepare_all

from lidar_perception.detectors.contract import DetectionResult
from lidar_perception.detectors.pointpillars.config import RANGES, make_config
from lidar_perception.detectors.pointpillars.targets import BACKGROUND, IGNORED, to_dense
from lidar_perception.geometry import is_within, wrap_angle
from lidar_perception.simulation import drive
from lidar_perception.simulation.camera import make_kitti_labels, rotate_camera
from lidar_perception.simulation.scene import Scenes
from lidar_perception.simulation.sensor import find_sensor
from lidar_perception.training import scenes as scenes_module
from lidar_perception.training.augment import TrainingScene, raise_scene
from lidar_perception.training.cut_objects import cut_objects
from lidar_perception.training.data import Batches, SceneReader, Stream, load_items
from lidar_perception.training.frames import open_labelled_frames
from lidar_perception.training.pointpillars.task import (
    Sample,
    ScenePreparation,
    load_validation_frame,
    make_loss,
    reduce_range,
    validate_detector,
)
from lidar_perception.training.record import select_metrics
from lidar_perception.training.scenes import SimulatedScenes
from lidar_perception.types import CLASSES, PEDESTRIAN, SENSOR_HEIGHT, Detections, GroundTruth, InputError

pytestmark = pytest.mark.no_cover  # covered by other tests

CAR, VAN = CLASSES.index("Car"), CLASSES.index("Van")
SENSOR = find_sensor("generic:8,-20,4,2,10")


# simulated scenes


def test_cached_scans_equal_simulated_ones(tmp_path, monkeypatch):
    plain = SimulatedScenes(7, 2, SENSOR)
    cached = SimulatedScenes(7, 2, SENSOR, cache=tmp_path / "cache")
    frame, truth = plain.load_scan(1)
    for _ in range(2):
        second_scan = cached.load_scan(1)
        assert np.array_equal(frame.xyz, second_scan[0].xyz)
        assert np.array_equal(frame.intensity, second_scan[0].intensity)
        assert np.array_equal(truth.boxes, second_scan[1].boxes) and truth.extras == second_scan[1].extras
        monkeypatch.setattr(scenes_module, "simulate_scan", None)  # the second one is read from the cache
    monkeypatch.undo()
    (file,) = (tmp_path / "cache").iterdir()
    file.write_bytes(file.read_bytes()[:100])  # a damaged file is computed again
    assert np.array_equal(cached.load_scan(1)[0].xyz, frame.xyz)
    full = SimulatedScenes(7, 2, SENSOR, cache=tmp_path / "cache", cache_gb=1e-9)
    full.load_scan(0)
    assert len(list((tmp_path / "cache").iterdir())) == 1


def test_hidden_simulated_objects_are_not_detectable():
    source = SimulatedScenes(7, 1, SENSOR)
    _, truth = source.load_scan(0)
    scene = source.load_scene(0)
    is_visible = [e["visible"] >= 0.15 and e["num_points"] >= 5 for e in truth.extras]
    assert scene.all_around and scene.detectable.tolist() == is_visible and 0 < sum(is_visible) < len(is_visible)
    assert drive.simulate_scan(7, 0, SENSOR).frame.xyz.shape == scene.points[:, :3].shape
    assert scene.height == source.load_frame(0).sensor_height == 1.73


# the stream


class Numbers:
    """Scene source with one point per scene, which contains the scene number."""

    def __init__(self, first: int, count: int):
        self.first, self.count = first, count

    def __len__(self):
        return self.count

    def load_scene(self, i):
        point = np.full((1, 4), self.first + i, np.float32)
        return TrainingScene(point, np.zeros((0, 7)), np.zeros(0, int), np.zeros(0, bool))


def take_batches(batches: Batches, first: int, steps: int) -> list:
    stream = batches(first)
    result = [[(float(a), c) for a, _, c in next(stream)] for _ in range(steps)]
    stream.close()
    return result


def test_stream_depends_only_on_seed():
    stream = Stream((Numbers(0, 7), Numbers(100, 4)), prepare_all, 5)
    whole = take_batches(Batches(stream, 3), 0, 12)
    assert take_batches(Batches(stream, 3), 5, 7) == whole[5:]  # as after an interruption
    assert take_batches(Batches(stream, 3, jobs=2), 0, 6) == whole[:6]
    pair = [take_batches(Batches(stream, 3, rank=rank, world_size=2), 0, 6) for rank in (0, 1)]
    assert [batch for both in zip(*pair) for batch in both] == whole
    assert take_batches(Batches(Stream(stream.sources, prepare_all, 6), 3), 0, 12) != whole
    flat = [point / 4 for batch in whole for point, _ in batch]
    assert sorted(flat[:11]) == sorted(flat[11:22]) == [*range(7), *range(100, 104)]
    assert flat[:11] != flat[11:22]
    assert Batches(stream, 3).steps_per_epoch == 4


# PointPillars' samples


def make_scene(**changes) -> TrainingScene:
    boxes = BOXES.numpy().astype(np.float64)
    return TrainingScene(
        **{
            **dict(
                points=make_two_objects(),
                boxes=boxes,
                detectable=np.ones(2, bool),
                class_ids=np.array([CAR, PEDESTRIAN]),
            ),
            **changes,
        }
    )


def to_labels(sample: Sample, anchors: torch.Tensor) -> torch.Tensor:
    return to_dense([sample.targets], len(anchors), torch.device("cpu")).labels[0]


@pytest.mark.parametrize("version", ["v0", "v2", "v4"])
def test_samples_have_inputs_of_version(version):
    config = make_tiny_config(version)
    sample = ScenePreparation(config, STILL)(make_scene(), np.random.default_rng(0))
    assert sample.points.shape[1] == config.point_columns
    assert (sample.cluster_map is not None) == config.pseudo_map
    assert sample.labels.tolist() == [0, 1] and sample.is_target.all()
    np.testing.assert_allclose(sample.boxes, BOXES, atol=1e-5)
    loss = make_loss(config, torch.device("cpu"))
    from lidar_perception.detectors.pointpillars.network import make_network

    total, parts = loss(make_network(config), [sample, sample])
    assert torch.isfinite(total) and set(parts) == {"classes", "boxes", "directions"}


def test_fraction_of_scenes_gets_pasted_objects(tmp_path):
    cut_objects(make_scene(), make_tiny_config().classes, 1).save(tmp_path / "objects.npz")
    rng, scene = np.random.default_rng(0), make_scene()
    scene = replace(scene, boxes=scene.boxes[:1], class_ids=scene.class_ids[:1], detectable=scene.detectable[:1])

    def numbers(crowded: float) -> list[int]:
        prepare = ScenePreparation(
            make_tiny_config(), replace(STILL, pedestrians=1, crowded=crowded), database=tmp_path / "objects.npz"
        )
        return [len(prepare(scene, rng).labels) for _ in range(10)]

    none, some, every = map(numbers, (0.0, 0.5, 1.0))
    assert set(none) == {1} and set(some) == {1, 2} and sum(every) > sum(none)


def test_anchors_on_hidden_objects_are_ignored():
    config = make_tiny_config()
    anchors, kinds = make_anchor_tensors(config)
    rng = np.random.default_rng(0)
    whole = ScenePreparation(config, STILL)(make_scene(), rng)
    found = to_labels(whole, anchors)
    for scene, prepare in (
        (make_scene(detectable=np.array([False, True])), ScenePreparation(config, STILL)),
        (make_scene(class_ids=np.array([VAN, PEDESTRIAN])), ScenePreparation(config, STILL)),
    ):
        sample = prepare(scene, rng)
        assert sample.is_target.tolist() == [False, True]
        labels = to_labels(sample, anchors)
        assert (labels != 0).all() and torch.equal(labels[kinds == 1], found[kinds == 1])
        near = (labels == IGNORED) & (kinds == 0)
        assert near.any() and (near | (labels == BACKGROUND) | (kinds != 0)).all()
        assert (found[near] != BACKGROUND).all()
    few_points = ScenePreparation(config, STILL, min_points=10**4)(make_scene(), rng)
    assert not few_points.is_target.any()


def test_scene_without_points_in_range_is_rejected():
    behind = make_scene(points=make_two_objects() * np.array([-1, 1, 1, 1], np.float32))
    with pytest.raises(InputError, match="no point"):
        ScenePreparation(make_tiny_config(), STILL)(behind, np.random.default_rng(0))
    far = ScenePreparation(make_tiny_config(), STILL)(
        make_scene(boxes=BOXES.numpy() + [90, 0, 0, 0, 0, 0, 0]), np.random.default_rng(0)
    )
    assert len(far.boxes) == 0 and len(far.labels) == 0
    assert (to_labels(far, make_anchor_tensors(make_tiny_config())[0]) == BACKGROUND).all()


def test_validation_scores_of_perfect_and_empty_detections(tmp_path):
    root = broken_folder(tmp_path)
    scenes = SceneReader((open_labelled_frames(root).to_scenes(),), partial(load_validation_frame, make_tiny_config()))
    right = validate_detector(lambda frame: DetectionResult(Detections.of([WALKER])), scenes)
    blind = validate_detector(lambda frame: DetectionResult(Detections.none()), scenes)
    assert right.compute()["frames"] == 3 and len(right.skipped) == 2
    names = ("Car", "Pedestrian", "Cyclist")
    for score in "bev", "map":
        metrics = select_metrics(right.compute(), score, names)
        assert metrics["score"] == metrics["Pedestrian_3d"] == 100.0
        assert np.isnan(metrics["Car_bev_relaxed"])
        assert select_metrics(blind.compute(), score, names)["score"] == 0.0
        assert np.isnan(select_metrics(right.compute(), score, ["Car"])["score"])  # no object of this class


@pytest.mark.parametrize("view", ["ahead", "around"])
def test_validation_without_camera_keeps_labels_in_range(view):
    config = make_config("v0", "compact", **(RANGES["around"] if view == "around" else {}))
    source = SimulatedScenes(7, 1, SENSOR, Scenes(None, 3.0, "campus"))
    known = source.load_frame(0).truth()
    truth = load_validation_frame(config, source, 0).truth()
    in_range = is_within(known.boxes, config.low, config.high)
    assert np.array_equal(truth.boxes, known.boxes[in_range]) and len(truth.extras) == len(truth)
    assert 0 < len(truth) and (len(truth) < len(known) or view == "around")


class Workers:
    """Items whose value is the id of the process that makes them."""

    def __getitem__(self, n: int) -> int:
        return os.getpid()


def test_workers_end_when_main_process_is_killed():
    script = (
        "from test_training_data import Workers\n"
        "from lidar_perception.training.data import load_items\n"
        "for pids in load_items(Workers(), ([n] for n in range(10**6)), 1):\n"
        "    print(pids[0], flush=True)\n"
        "    input()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script],
        cwd=Path(__file__).parent,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    ) as run:
        worker = Path(f"/proc/{int(run.stdout.readline())}/stat")
        assert worker.exists()
        run.kill()
    end = time.monotonic() + 30
    while worker.exists() and worker.read_text().split()[2] != "Z":
        assert time.monotonic() < end, "the worker lives on"
        time.sleep(0.05)


class Large:
    """Items with the id of the process that makes them, larger than the buffer of a pipe."""

    def __getitem__(self, n: int) -> tuple[int, bytes]:
        return os.getpid(), bytes(10**7)


@pytest.mark.parametrize("jobs", [1, 2])
def test_training_ends_with_reason_if_worker_is_killed(jobs):
    batches = load_items(Large(), ([n] for n in range(10**6)), jobs)
    pid = next(batches)[0][0]
    time.sleep(0.2)  # the process is sending its next item
    os.kill(pid, signal.SIGKILL)
    with pytest.raises(InputError, match=r"prepared scenes.*code -9.*try fewer --jobs"):
        for _ in range(20):
            next(batches)


# sensor height and range


def test_samples_do_not_depend_on_sensor_height():
    scene = make_scene()
    for config in make_tiny_config(), make_tiny_config("v4"):
        usual = ScenePreparation(config, STILL)(scene, np.random.default_rng(0))
        for height in 0.6, 2.4:
            other = replace(raise_scene(scene, SENSOR_HEIGHT - height), height=height)
            sample = ScenePreparation(config, STILL)(other, np.random.default_rng(0))
            assert np.allclose(sample.points, usual.points, atol=1e-5)
            assert np.allclose(sample.boxes, usual.boxes, atol=1e-5)
            assert np.array_equal(sample.labels, usual.labels)
            assert np.array_equal(sample.is_target, usual.is_target)


@pytest.mark.parametrize("quarter", range(4))
def test_rotating_the_camera_equals_rotating_the_scene(quarter):
    _, truth = SimulatedScenes(7, 1, SENSOR).load_scan(0)
    yaw = quarter * np.pi / 2
    cos, sin = np.cos(-yaw), np.sin(-yaw)
    boxes = truth.boxes.copy()
    boxes[:, :2] = boxes[:, :2] @ np.array([[cos, sin], [-sin, cos]])
    boxes[:, 6] = wrap_angle(boxes[:, 6] - yaw)
    rotated_labels = make_kitti_labels(GroundTruth.of(boxes, truth.class_ids, truth.extras))
    camera_labels = make_kitti_labels(truth, rotate_camera(yaw))
    assert [e["track_id"] for e in camera_labels.extras] == [e["track_id"] for e in rotated_labels.extras]
    assert len(camera_labels.notes) == len(rotated_labels.notes)
    frame = SimulatedScenes(4, 8, SENSOR, all_around=True).load_frame(quarter + 4)
    assert np.allclose(frame.calibration().lidar_to_camera, rotate_camera(yaw).lidar_to_camera)


def test_reduced_range_covers_all_directions():
    around = make_config("v0", "compact", **RANGES["around"])
    part = reduce_range(around, 30.0, 20.0)
    assert part.low[:2] == pytest.approx((-30.72, -20.48)) and part.high[:2] == pytest.approx((30.72, 20.48))
    assert reduce_range(around, 1000.0, 1000.0) == around
