"""Every detector of the package meets the detector contract."""

from __future__ import annotations

import inspect

import detection_samples
import numpy as np
import pointnet_samples
import pytest
from detection_samples import are_equal_detections
from hypothesis import given
from hypothesis import strategies as st
from samples import CALIBRATION, make_crowd

from experiments.comparison.contenders import open_contenders
from lidar_perception.classes import CAR
from lidar_perception.data.frame import Frame
from lidar_perception.detectors import normalized_view, weights_file
from lidar_perception.detectors.checkpoint import Header, save_checkpoint
from lidar_perception.detectors.contract import DetectionResult
from lidar_perception.detectors.normalized_view import drop_ego_vehicle, restore_detections
from lidar_perception.geometry import points_in_box
from lidar_perception.ground.params import SensorPoseParams
from lidar_perception.types import CLASSES, SENSOR_HEIGHT, Detections, InputError, PointCloud

pytestmark = pytest.mark.usefixtures("one_thread")
NAMES = ["STM-CPA paper", "STM-CPA best", "STM-CPA best, auto", "PointPillars v0 compact", "PointNet"]
each_name = pytest.mark.parametrize("name", NAMES)


@pytest.fixture(scope="module")
def frame():
    cloud, truth = make_crowd(1)
    return Frame.of("crowd", PointCloud(cloud[:, :3].copy(), cloud[:, 3].copy()), truth, CALIBRATION)


@pytest.fixture(scope="module")
def detectors(frame, tmp_path_factory):
    """Return the detector of every contender by name, with random networks."""
    folder = tmp_path_factory.mktemp("weights")
    for name, samples, config in (
        ("a", detection_samples, detection_samples.make_tiny_config()),
        ("b", pointnet_samples, pointnet_samples.make_small_config()),
    ):
        save_checkpoint(folder / name, samples.make_random_network(config), Header(config))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(weights_file, "POINTPILLARS_WEIGHTS", folder / "none")
        patch.setattr(weights_file, "POINTNET_WEIGHTS", folder / "none")
        contenders, _ = open_contenders([folder / "a", folder / "b"], "cpu")
    return {contender.name: contender.make_detector(frame) for contender in contenders}


def test_every_detector_is_tested(detectors):
    assert list(detectors) == NAMES


@each_name
def test_detector_has_classes_and_thresholds(detectors, name):
    detector = detectors[name]
    assert detector.classes and set(detector.classes) <= set(CLASSES)
    assert set(detector.min_scores) == set(detector.classes)
    columns = inspect.signature(detector).parameters
    assert [p.kind for p in columns.values()] == [
        inspect.Parameter.POSITIONAL_OR_KEYWORD,
        *[inspect.Parameter.KEYWORD_ONLY] * 2,
    ]
    assert [*columns][1:] == ["ground", "cluster_ids"]


@each_name
def test_array_and_frame_give_equal_detections(detectors, frame, name):
    """Columns have a value for every row, including unusable points."""
    scan, detector = frame.load(), detectors[name]
    cloud, ground = scan.points(), scan.xyz[:, 2] < -1.5
    assert are_equal_detections(detector(cloud), detector(scan))
    expected = detector(scan, ground=ground)
    invalid_cloud = np.insert(cloud, [0, 50], [[np.nan] * 4, [0, 0, 0, 1]], axis=0)
    assert are_equal_detections(detector(invalid_cloud, ground=np.insert(ground, [0, 50], True)), expected)
    assert are_equal_detections(
        detector(invalid_cloud.tolist(), ground=np.insert(ground, [0, 50], True).tolist()), expected
    )
    if "STM-CPA" not in name or "auto" in name:  # the others have no seed in this frame
        assert len(detector([]).detections) == 0 and detector(np.full((9, 3), np.nan)).problem
    for argument, message in ((np.ones((5, 5)), r"points\[:, :4\]"), (frame, "frame.load"), (None, "NoneType")):
        with pytest.raises(InputError, match=message):
            detector(argument)


@each_name
@pytest.mark.parametrize("full_scale", [255, 65535])
def test_other_intensity_scale_is_reported_and_normalized(detectors, frame, name, full_scale):
    scan, detector = frame.load(), detectors[name]
    assert scan.intensity.max() > 0.5
    points = np.column_stack([scan.xyz, np.round(scan.intensity * full_scale)])
    result, expected = detector(points), detector(PointCloud.of(points, intensity_max=full_scale))
    assert are_equal_detections(result.detections, expected.detections)
    if name.startswith("STM-CPA") and "PointNet" not in name:  # these do not use intensity
        assert result.problem == expected.problem
    else:
        assert f"full scale of {full_scale} is assumed" in result.problem and "PointCloud.of" in result.problem
        assert "is assumed" not in (expected.problem or "")


@given(st.integers(0, 2**32 - 1))
def test_ego_vehicle_is_dropped_for_any_heading(seed):
    """Boxes that contain the sensor or a mast of 1 m, and cars below it within 1 m, are dropped."""
    rng = np.random.default_rng(seed)
    boxes = np.column_stack([rng.uniform(-4, 4, (50, 3)), rng.uniform(0.5, 5, (50, 3)), rng.uniform(-4, 4, 50)])
    class_ids = np.arange(50) % len(CLASSES)
    remaining = {tuple(box) for box in drop_ego_vehicle(Detections.of(boxes, class_ids), SENSOR_HEIGHT).boxes.tolist()}
    angle = np.linspace(0, 2 * np.pi, 721)
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(721)])
    disc = np.concatenate([ring * share for share in np.linspace(0, 1, 21)])
    for box, class_id in zip(boxes, class_ids):
        extended_box = box + [0, 0, 0, 0, 0, 2.0, 0]
        is_dropped = points_in_box(np.zeros((1, 3)), extended_box)[0]
        if class_id == CAR and box[2] + box[5] / 2 < 0:
            if points_in_box(disc, extended_box).any() != points_in_box(1.02 * disc, extended_box).any():
                continue  # so close to the limit that rounding decides
            is_dropped = points_in_box(disc, extended_box).any()
        assert (tuple(box.astype(np.float32).tolist()) in remaining) != is_dropped


@pytest.mark.parametrize(
    "pose",
    [SensorPoseParams(), SensorPoseParams(height=2.4), SensorPoseParams(roll=np.pi), SensorPoseParams(height=6.0)],
)
def test_ego_vehicle_is_dropped_and_nearest_car_is_kept(pose):
    """Drop three boxes on the ego vehicle's own roof, as in KITTI, for sensors up to MAX_MAST_M above it."""
    offset = pose.height - SENSOR_HEIGHT
    roof = np.array(
        [
            [-0.2, 0.1, offset - 1.0, 3.8, 1.6, 1.5, 0.9],
            [0.8, -1.7, offset - 1.0, 4.0, 1.7, 1.5, -0.1],
            [-1.5, -0.2, offset - 1.1, 4.0, 1.6, 1.5, 1.6],
        ]
    )
    next_car = [0.0, -2.8, offset - 1.0, 4.0, 1.6, 1.5, 0.0]
    boxes = restore_detections(Detections.of([*roof, next_car], CAR), pose).boxes
    assert len(boxes) == 1 and abs(boxes[0, 1]) == np.float32(2.8)
    low_cars = Detections.of(roof - [0, 0, 4.3, 0, 0, 0, 0], CAR)
    assert len(restore_detections(low_cars, pose)) == 3


def test_every_network_drops_the_ego_vehicle(detectors, frame, monkeypatch):
    monkeypatch.setattr(normalized_view, "drop_ego_vehicle", lambda detections, height: detections[:0])
    for name in NAMES:
        if name.startswith("P"):
            assert len(detectors[name](frame.load()).detections) == 0


@each_name
def test_second_call_gives_equal_result_for_unchanged_frame(detectors, frame, name):
    scan = frame.load()
    original = scan.xyz.copy(), scan.intensity.copy()
    result, second_result = (detectors[name](scan) for _ in range(2))
    assert isinstance(result, DetectionResult) and are_equal_detections(result, second_result)
    assert (result.problem, result.best) == (second_result.problem, second_result.best)
    assert result.timings.keys() == second_result.timings.keys()
    assert {CLASSES[i] for i in result.detections.class_ids} <= set(detectors[name].classes)
    np.testing.assert_array_equal(scan.xyz, original[0])
    np.testing.assert_array_equal(scan.intensity, original[1])


@each_name
def test_with_min_score_returns_a_copy(detectors, frame, name):
    detector, scan = detectors[name], frame.load()
    result, scores = detector(scan), dict(detector.min_scores)
    strict_detector = detector.with_min_score(0.6)
    assert type(strict_detector) is type(detector) and strict_detector.classes == detector.classes
    assert set(strict_detector.min_scores.values()) == {0.6}
    assert (strict_detector(scan).detections.scores >= np.float32(0.6)).all()
    assert dict(detector.min_scores) == scores and are_equal_detections(detector(scan), result)
    assert len(result.detections) > 0 or result.best


@each_name
def test_column_of_wrong_length_is_named_in_the_error(detectors, frame, name):
    scan = frame.load()
    for column, values in dict(
        ground=np.zeros(len(scan) - 1, bool), cluster_ids=np.zeros(len(scan) + 1, np.int32)
    ).items():
        with pytest.raises(InputError, match=rf"^{column} has {len(values)} values for {len(scan)} points"):
            detectors[name](scan, **{column: values})
