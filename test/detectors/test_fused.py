"""The fused detector: box corrections, combination of evidence, and the detector contract."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from detection_samples import frame, random_detector, same
from hypothesis import given
from hypothesis import strategies as st
from pointnet_samples import random_detector as random_classifier

from lidar_perception.classes import CAR
from lidar_perception.detectors.boxes import (
    FRONT,
    MARGIN_M,
    SIDE,
    move_cars_to_points,
    move_to_ground,
    move_to_points,
    move_towards,
)
from lidar_perception.detectors.contract import DetectionResult
from lidar_perception.detectors.devices import CPU
from lidar_perception.detectors.fused.detector import FusedDetector, load_fused_detector, remove_duplicates
from lidar_perception.detectors.fused.evidence import (
    MIN_PROBABILITY,
    compute_max_probabilities,
    compute_probabilities,
    to_log_odds,
)
from lidar_perception.detectors.fused.fusion import KNOTS, load_shipped_models
from lidar_perception.detectors.fused.params import STEPS, FusedDetectorParams, FusedParams
from lidar_perception.detectors.normalized_view import NormalizedView, drop_ego_vehicle, segment_view_ground
from lidar_perception.detectors.pointnet import classifier
from lidar_perception.detectors.trained_network import Placement
from lidar_perception.geometry import bev_iou, centre_distances, points_in_box, points_in_boxes, wrap_angle
from lidar_perception.param_fields import with_values
from lidar_perception.simulation.scene import Scenes
from lidar_perception.simulation.sensor import find_sensor
from lidar_perception.training.scenes import SimulatedScenes
from lidar_perception.types import CLASSES, PEDESTRIAN, Detections, InputError, PointCloud

# covered by other tests
pytestmark = [pytest.mark.no_cover, pytest.mark.usefixtures("one_thread")]
SEEDS = st.integers(0, 2**32 - 1)
EAGER = FusedDetectorParams(fused=FusedParams(warm_up=False))


def random_boxes(rng, count: int) -> np.ndarray:
    return np.column_stack(
        [
            rng.uniform(-20, 20, (count, 2)),
            rng.uniform(-1.5, 0, count),
            rng.uniform(0.3, 5, (count, 3)),
            rng.uniform(-4, 4, count),
        ]
    )


@given(SEEDS, st.integers(0, 2000), st.integers(0, 30), st.floats(0, 0.5))
def test_points_in_boxes_equals_points_in_each_box(seed, count, boxes, margin):
    rng = np.random.default_rng(seed)
    xyz = rng.uniform([-22, -22, -2], [22, 22, 2], (count, 3)).astype(np.float32)
    xyz[::50, rng.integers(3)] = rng.choice([np.nan, np.inf, -np.inf, 1e30])
    boxes = random_boxes(rng, boxes).astype(np.float32)
    indices, first = points_in_boxes(xyz, boxes, margin)
    assert first[0] == 0 and first[-1] == len(indices) and len(first) == len(boxes) + 1
    for k, box in enumerate(boxes):
        np.testing.assert_array_equal(indices[first[k] : first[k + 1]], np.flatnonzero(points_in_box(xyz, box, margin)))


def shell(box: np.ndarray, rng, count: int = 400) -> np.ndarray:
    """Return points on the two faces of a box that a sensor at the origin sees."""
    sensor = np.array([[np.cos(box[6]), np.sin(box[6])], [-np.sin(box[6]), np.cos(box[6])]]) @ (-box[:2])
    flat = rng.uniform(-0.5, 0.5, (count, 3)) * box[3:6]
    half = np.arange(count) < count // 2
    for axis, depth in ((0, FRONT), (1, SIDE)):
        own = half == (axis == 0)
        flat[own, axis] = np.sign(sensor[axis]) * (box[3 + axis] / 2 - depth)
    cos, sin = np.cos(box[6]), np.sin(box[6])
    return (
        np.column_stack([cos * flat[:, 0] - sin * flat[:, 1], sin * flat[:, 0] + cos * flat[:, 1], flat[:, 2]])
        + box[:3]
    )


@given(SEEDS)
def test_move_to_points_corrects_shifted_car_only(seed):
    rng = np.random.default_rng(seed)
    away = rng.uniform(8, 30)
    way = rng.uniform(-np.pi, np.pi)
    box = np.array(
        [away * np.cos(way), away * np.sin(way), -0.9, 4.0, 1.7, 1.5, way + rng.choice([-1, 1]) * rng.uniform(0.6, 0.9)]
    )  # two faces are visible
    points = shell(box, rng)
    off = box.copy()
    off[:2] += rng.uniform(-0.2, 0.2, 2)
    both = move_to_points(np.stack([box, off]), points, 1.0)
    np.testing.assert_allclose(both, [box, box], atol=0.02)
    half = move_to_points(off[None], points, 0.5)[0]
    np.testing.assert_allclose(half, (off + box) / 2, atol=0.02)
    np.testing.assert_array_equal(move_to_points(off[None], points, 0.0)[0], off)
    np.testing.assert_array_equal(move_to_points(off[None], points[:0], 1.0)[0], off)
    cars = move_cars_to_points(np.stack([off, off]), np.array([CAR, PEDESTRIAN]), points, 1.0)
    np.testing.assert_array_equal(cars, [move_to_points(off[None], points, 1.0)[0], off])
    # Never farther than the margin, however far the points are.
    moved = move_to_points(off[None], points + [0.3, 0, 0], 1.0)
    assert np.hypot(*(moved - off)[0, :2]) <= 2 * MARGIN_M


def test_move_to_ground_skips_unknown_heights():
    boxes = random_boxes(np.random.default_rng(0), 20)
    floors = np.where(np.arange(20) % 4, boxes[:, 2] - 1, np.nan)
    on = move_to_ground(boxes, floors, 1.0)
    known = np.isfinite(floors)
    np.testing.assert_allclose((on[:, 2] - on[:, 5] / 2)[known], floors[known])
    np.testing.assert_array_equal(on[~known], boxes[~known])
    np.testing.assert_array_equal(move_to_ground(boxes, floors, 0.0), boxes)


@given(SEEDS)
def test_move_towards_interpolates_and_keeps_heading(seed):
    rng = np.random.default_rng(seed)
    boxes, others = random_boxes(rng, 20), random_boxes(rng, 20)
    silent = rng.random(20) < 0.3
    others[silent] = np.nan
    there, half, none = (move_towards(boxes, others, share) for share in (1.0, 0.5, 0.0))
    np.testing.assert_allclose(none[:, :6], boxes[:, :6])
    np.testing.assert_allclose(wrap_angle(none[:, 6] - boxes[:, 6]), 0, atol=1e-9)
    np.testing.assert_array_equal(half[silent], none[silent])
    np.testing.assert_allclose(there[~silent, :6], others[~silent, :6])
    np.testing.assert_allclose(half[:, :6], (none + there)[:, :6] / 2)
    # Headings are interpolated modulo 180 degrees, so they change by at most 90 degrees.
    np.testing.assert_allclose(np.sin(there - others)[~silent, 6], 0, atol=1e-9)
    turned, halfway = (wrap_angle(moved[:, 6] - none[:, 6]) for moved in (there, half))
    assert (np.abs(turned) <= np.pi / 2 + 1e-9).all() and (np.abs(half[:, 6]) <= np.pi).all()
    np.testing.assert_allclose(halfway, turned / 2, atol=1e-9)


@given(SEEDS)
def test_probability_increases_with_evidence(seed):
    rng = np.random.default_rng(seed)
    class_ids = rng.choice([CLASSES.index(name) for name in load_shipped_models()], 50)
    evidence = {source: to_log_odds(rng.uniform(0, 1, 50)) for source in KNOTS}
    models = load_shipped_models()
    before = compute_probabilities(models, class_ids, evidence)
    assert ((before >= 0) & (before <= 1)).all() and before.dtype == np.float32
    for source in KNOTS:
        more = {**evidence, source: evidence[source] + rng.uniform(0, 3, 50)}
        assert (compute_probabilities(models, class_ids, more) >= before - 1e-6).all()
        silent = {**evidence, source: np.full(50, np.nan)}
        assert np.isfinite(compute_probabilities(load_shipped_models(), class_ids, silent)).all()
    unknown = np.full(50, CLASSES.index("Tram"))
    assert not compute_probabilities(load_shipped_models(), unknown, evidence).any()
    least = to_log_odds(MIN_PROBABILITY)
    np.testing.assert_allclose(to_log_odds([0, 0.5, 1]), [least, 0, -least], atol=1e-9)


@given(st.integers(0, 2**32 - 1))
def test_max_probability_holds_for_any_evidence_and_curve(seed):
    """PointNet skips proposals whose upper bound is below the threshold."""
    rng = np.random.default_rng(seed)
    models = {
        name: {
            "bias": rng.normal(),
            "curves": {
                source: {
                    "knots": [-3.0, -1.0, 1.0, 3.0],
                    "values": rng.normal(0, 2, 4).tolist(),
                    **({"unknown": rng.normal(0, 2)} if rng.random() < 0.5 else {}),
                }
                for source in ("network", "classifier")[: rng.integers(1, 3)]
            },
        }
        for name in CLASSES[:2]
    }
    ids, network = rng.integers(0, 3, 6), rng.normal(0, 3, 6)
    bound = compute_max_probabilities(models, ids, {"network": network}, "classifier")
    answers = [
        compute_probabilities(models, ids, {"network": network, "classifier": np.full(6, odds)})
        for odds in (np.nan, -np.inf, np.inf, *np.linspace(-4, 4, 33))
    ]
    np.testing.assert_array_equal(bound, np.max(answers, axis=0))


def test_remove_duplicates_by_class():
    boxes = np.array(
        [
            [10, 0, 0, 0.6, 0.6, 1.8, 0],
            [10.5, 0.2, 0, 0.6, 0.6, 1.8, 0],
            [10, 5, 0, 4, 1.7, 1.5, 0],
            [10, 6.8, 0, 4, 1.7, 1.5, 0],
            [10.3, 5.1, 0, 4, 1.7, 1.5, 0],
            [10.2, 0, 0, 1.7, 0.6, 1.8, 0],
            [14, 5.1, 0, 4, 1.7, 1.5, 0],
            [10.5, 0.85, 0, 0.6, 0.8, 1.8, 0],
        ]
    )
    ids = np.array([PEDESTRIAN] * 2 + [CAR] * 3 + [CLASSES.index("Cyclist"), CAR, PEDESTRIAN])
    found = Detections.of(boxes, ids, [0.5, 0.8, 0.9, 0.7, 0.95, 0.4, 0.3, 0.2])
    (car, person), (other, beside) = boxes[[4, 1]], boxes[[6, 7]]  # each pair overlaps by 4 %
    assert min(bev_iou(car[None], other[None]), bev_iou(person[None], beside[None])) > 0.03
    assert remove_duplicates(found, FusedParams()).tolist() == [4, 1, 3, 5, 7]
    assert len(remove_duplicates(found[:0], FusedParams())) == 0


@pytest.fixture(scope="module")
def detector():
    eager = with_values(
        FusedDetectorParams(), {f"fused.scores.{name}": 0.0 for name in ("car", "pedestrian", "cyclist", "other")}
    )
    return FusedDetector(random_detector("v4").proposer, random_classifier().classifier, eager)


def test_fused_fulfills_the_detector_contract(detector):
    scan = frame()
    found = detector(scan)
    assert len(found.detections) > 3 and tuple(found.timings) == STEPS
    assert (np.diff(found.detections.scores) <= 0).all()
    assert same(detector(scan), found)  # no state is left in the detector
    said = found.detections.sources
    assert set(said) == set(KNOTS) and all(len(x) == len(found.detections) for x in said.values())
    cars = found.detections.class_ids == CAR
    assert np.isnan(said["silhouette"][cars]).all() and np.isfinite(said["network"]).all()
    middle = float(np.median(found.detections.scores))
    strict = detector.with_min_score(middle)
    assert set(strict.min_scores.values()) == {middle}
    assert same(strict(scan), found.detections[found.detections.scores >= middle])
    assert same(detector(scan), found)
    nothing = detector.with_min_score(1.0)(scan)
    assert len(nothing.detections) == 0 and set(nothing.best) == set(detector.classes)
    empty = detector(PointCloud(np.zeros((0, 3), np.float32), np.zeros(0, np.float32)))
    assert len(empty.detections) == 0 and "no finite point" in empty.problem
    with pytest.raises(InputError, match="ground has 3 values"):
        detector(scan, ground=np.zeros(3, bool))


def test_sensor_height_and_given_columns_change_nothing(detector):
    scan = frame()
    found = detector(scan).detections
    high = replace(scan, xyz=scan.xyz - np.array([0, 0, 0.5], np.float32))
    above = detector.with_sensor_height(1.73 + 0.5)(high).detections
    above = replace(above, boxes=above.boxes + np.array([0, 0, 0.5, 0, 0, 0, 0], np.float32))
    # Except boxes that count as the ego vehicle of one of the sensors.
    above, below = drop_ego_vehicle(above, 1.73), drop_ego_vehicle(found, 1.73 + 0.5)
    assert len(below) > 90
    np.testing.assert_allclose(above.boxes, below.boxes, atol=2e-3)
    np.testing.assert_allclose(above.scores, below.scores, atol=2e-3)
    # Points outside the range do not need a ground label.
    config = detector.proposer.config
    view = NormalizedView.of(scan, low=config.low, high=config.high)
    ground = np.zeros(len(scan), bool)
    ground[view.indices] = segment_view_ground(view.frame, detector.params.ground)
    assert same(detector(scan, ground=ground), found)
    assert same(detector(scan, ground=ground | ~np.isin(np.arange(len(scan)), view.indices)), found)


@pytest.mark.parametrize("use_intensity", [True, False])
@pytest.mark.parametrize("height", [1.73, 2.5])
def test_ground_of_experts_in_range_gives_equal_detections(detector, height, use_intensity):
    """The ground_segmentation node segments only the range of the detector, with intensity."""
    own = detector.with_params(with_values(detector.params, {"fused.use_intensity": use_intensity})).with_sensor_height(
        height
    )
    scan, config = frame(), own.proposer.config
    scan = replace(scan, xyz=scan.xyz - np.array([0, 0, height - 1.73], np.float32))
    view = NormalizedView.of(scan, own.params.ground.sensor_pose, config.low, config.high)
    ground = np.zeros(len(scan), bool)
    ground[view.indices] = segment_view_ground(view.frame, own.params.ground)
    found = own(scan)
    assert len(found.detections) > 3 and same(own(scan, ground=ground), found)


def test_ignored_intensity_equals_missing_intensity(detector):
    """This includes the ground segmentation, which removes low dark points as reflections."""
    scan, other = frame(), copy.copy(detector)
    other.params = with_values(detector.params, {"fused.use_intensity": False})
    pit = np.random.default_rng(0).uniform([4, -4, -2.81], [9, 4, -2.79], (3000, 3))
    scan = PointCloud(
        np.concatenate([scan.xyz, pit.astype(np.float32)]),
        np.concatenate([scan.intensity, np.full(3000, 0.5, np.float32)]),
    )
    without = replace(scan, intensity=None)
    assert "no intensity" in detector(without).problem and other(without).problem is None
    assert same(other(scan), other(without)) and other(scan).problem is None
    surfaces = [one.propose(scan).surface.heights for one in (other, detector)]
    np.testing.assert_array_equal(*surfaces)


def test_max_proposals_keeps_the_best_boxes(detector):
    whole, other = copy.copy(detector), copy.copy(detector)
    own = with_values(detector.params, {"fused.classifier_box": 0.0})
    whole.params, other.params = own, with_values(own, {"fused.max_proposals": 9})
    every = whole.propose(frame()).detections
    few = other.propose(frame()).detections  # without the ego vehicle
    assert len(every) > 100 and 0 < len(few) <= 9 and same(few, every[: len(few)])


def test_classifier_box_interpolates_between_networks(detector):
    def looked(share: float) -> tuple[np.ndarray, np.ndarray]:
        other = copy.copy(detector)
        other.params = with_values(detector.params, {"fused.classifier_box": share})
        proposals = other.propose(frame())
        return proposals.detections.boxes, np.isfinite(proposals.evidence["classifier"])

    (own, asked), (half, _), (judged, _) = (looked(share) for share in (0.0, 0.5, 1.0))
    assert asked.any() and not asked.all()
    np.testing.assert_array_equal((own != judged).any(axis=1), asked)
    np.testing.assert_allclose(half[:, :6], (own + judged)[:, :6] / 2, atol=1e-4)


def test_hilly_ground_changes_only_the_height_of_boxes():
    """The networks get the points relative to flat ground."""
    detector = load_fused_detector("", "cpu", EAGER).with_range("around")
    scan = (
        SimulatedScenes(7, 1, find_sensor("hdl64e", 0.0), Scenes(None, 3.0, "street"), all_around=True)
        .load_frame(0)
        .load()
    )

    def hills(xy: np.ndarray) -> np.ndarray:
        return 0.04 * xy[:, 0] + 0.5 * np.sin(xy[:, 1] / 12)

    xyz = scan.xyz + np.outer(hills(scan.xyz), [0, 0, 1]).astype(np.float32)
    plain, hilly = detector(scan).detections, detector(replace(scan, xyz=xyz)).detections
    plain = plain[plain.scores > 0.8]
    distances = centre_distances(plain.boxes, hilly.boxes)
    found = distances.min(axis=1) < 0.2
    assert found.sum() > 3 and found.mean() > 0.8
    rise = (hilly.boxes[distances.argmin(axis=1), 2] - plain.boxes[:, 2])[found]
    np.testing.assert_allclose(rise, hills(plain.boxes)[found], atol=0.1)
    assert np.ptp(rise) > 0.5


@pytest.mark.parametrize("height, stays", [(0.4, True), (1.0, True), (1.73, False), (6.0, True)])
def test_nearby_car_that_is_not_ego_vehicle_is_kept(detector, monkeypatch, height, stays):
    """The ego vehicle is determined with the actual sensor height instead of 1.73 m."""
    car = Detections.of([[0, 1.4, -0.98, 4, 1.6, 1.5, 0]], CAR, 0.9)  # 0.6 m aside
    monkeypatch.setattr(detector.proposer.__class__, "propose", lambda *_: DetectionResult(car))
    assert len(detector.with_sensor_height(height).propose(frame()).detections) == stays


def test_cpu_fallback_of_one_network_is_reported(detector):
    other = copy.copy(detector)
    other.classifier = copy.copy(detector.classifier)
    other.classifier.placement = Placement(CPU, "cuda is out of memory")
    assert other(frame()).problem == "cuda is out of memory" and detector(frame()).problem is None


def test_without_cpu_fallback_the_error_is_raised(detector, monkeypatch):
    """The parameter applies to both networks."""

    def predict(*_, **__):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(classifier, "predict", predict)
    other = copy.copy(detector)
    other.classifier = copy.copy(detector.classifier)
    other.classifier.placement = Placement("meta")
    other.params = with_values(detector.params, {"fused.cpu_fallback": False})
    with pytest.raises(InputError, match="meta is out of memory"):
        other(frame())


def test_parameters_can_change_between_clouds(detector):
    other = copy.copy(detector)
    other.params = with_values(detector.params, {"fused.proposals": 0.6})
    assert len(other(frame()).detections) < len(detector(frame()).detections)
    assert same(detector(frame()), detector(frame()))


def test_clouds_without_usable_intensity_have_their_own_curves():
    detector = load_fused_detector("", "cpu", EAGER)
    dark = copy.copy(detector)
    dark.models = detector.models_without_intensity
    assert dark.models != detector.models
    scan = frame()
    without = replace(scan, intensity=None)
    any_score = detector.with_min_score(0.0), dark.with_min_score(0.0)
    assert same(*(each(without) for each in any_score)) and not same(*(each(scan) for each in any_score))
    assert same(detector(replace(scan, intensity=np.full_like(scan.intensity, 0.3))), detector(without))
    off = detector.with_params(with_values(detector.params, {"fused.use_intensity": False}))
    assert same(off(scan), detector(without))
    low = detector.with_min_score(0.01)
    assert len(low(without).detections) >= len(detector(without).detections)
    one_set = FusedDetector(detector.proposer, detector.classifier, detector.params, detector.models)
    assert one_set.models_without_intensity is one_set.models
