"""The fused detector: the detector contract, its parameters, and separate curves."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from detection_samples import are_equal_detections, make_random_detector, make_scan
from pointnet_samples import make_random_detector as make_pointnet_detector

from lidar_perception.classes import CAR
from lidar_perception.detectors.contract import DetectionResult
from lidar_perception.detectors.devices import CPU
from lidar_perception.detectors.fused.detector import FusedDetector, load_fused_detector
from lidar_perception.detectors.fused.fusion import KNOTS
from lidar_perception.detectors.fused.params import STEPS, FusedDetectorParams, FusedParams
from lidar_perception.detectors.normalized_view import NormalizedView, drop_ego_vehicle, segment_view_ground
from lidar_perception.detectors.pointnet import classifier
from lidar_perception.detectors.trained_network import Placement
from lidar_perception.geometry import centre_distances
from lidar_perception.param_fields import with_values
from lidar_perception.simulation.scene import Scenes
from lidar_perception.simulation.sensor import find_sensor
from lidar_perception.training.scenes import SimulatedScenes
from lidar_perception.types import Detections, InputError, PointCloud

# covered by other tests
pytestmark = [pytest.mark.no_cover, pytest.mark.usefixtures("one_thread")]
EAGER = FusedDetectorParams(fused=FusedParams(warm_up=False))


@pytest.fixture(scope="module")
def detector():
    eager = with_values(
        FusedDetectorParams(), {f"fused.scores.{name}": 0.0 for name in ("car", "pedestrian", "cyclist", "other")}
    )
    return FusedDetector(make_random_detector("v4").proposer, make_pointnet_detector().classifier, eager)


def test_fused_detector_meets_the_contract(detector):
    scan = make_scan()
    result = detector(scan)
    assert len(result.detections) > 3 and tuple(result.timings) == STEPS
    assert (np.diff(result.detections.scores) <= 0).all()
    assert are_equal_detections(detector(scan), result)  # the detector keeps no state
    sources = result.detections.sources
    assert set(sources) == set(KNOTS) and all(len(x) == len(result.detections) for x in sources.values())
    is_car = result.detections.class_ids == CAR
    assert np.isnan(sources["silhouette"][is_car]).all() and np.isfinite(sources["network"]).all()
    median_score = float(np.median(result.detections.scores))
    strict_detector = detector.with_min_score(median_score)
    assert set(strict_detector.min_scores.values()) == {median_score}
    assert are_equal_detections(strict_detector(scan), result.detections[result.detections.scores >= median_score])
    assert are_equal_detections(detector(scan), result)
    nothing = detector.with_min_score(1.0)(scan)
    assert len(nothing.detections) == 0 and set(nothing.best) == set(detector.classes)
    empty = detector(PointCloud(np.zeros((0, 3), np.float32), np.zeros(0, np.float32)))
    assert len(empty.detections) == 0 and "no finite point" in empty.problem
    with pytest.raises(InputError, match="ground has 3 values"):
        detector(scan, ground=np.zeros(3, bool))


def test_sensor_height_and_given_columns_keep_the_result(detector):
    scan = make_scan()
    detections = detector(scan).detections
    higher_scan = replace(scan, xyz=scan.xyz - np.array([0, 0, 0.5], np.float32))
    higher_detections = detector.with_sensor_height(1.73 + 0.5)(higher_scan).detections
    higher_detections = replace(
        higher_detections, boxes=higher_detections.boxes + np.array([0, 0, 0.5, 0, 0, 0, 0], np.float32)
    )
    # Boxes that count as the ego vehicle for one of the sensors are excluded.
    higher_detections, lower_detections = (
        drop_ego_vehicle(higher_detections, 1.73),
        drop_ego_vehicle(detections, 1.73 + 0.5),
    )
    assert len(lower_detections) > 90
    np.testing.assert_allclose(higher_detections.boxes, lower_detections.boxes, atol=2e-3)
    np.testing.assert_allclose(higher_detections.scores, lower_detections.scores, atol=2e-3)
    # Points outside the range do not need a ground label.
    config = detector.proposer.config
    view = NormalizedView.of(scan, low=config.low, high=config.high)
    ground = np.zeros(len(scan), bool)
    ground[view.indices] = segment_view_ground(view.frame, detector.params.ground)
    assert are_equal_detections(detector(scan, ground=ground), detections)
    assert are_equal_detections(
        detector(scan, ground=ground | ~np.isin(np.arange(len(scan)), view.indices)), detections
    )


@pytest.mark.parametrize("use_intensity", [True, False])
@pytest.mark.parametrize("height", [1.73, 2.5])
def test_ground_computed_by_a_node_gives_equal_detections(detector, height, use_intensity):
    """The ground_segmentation node segments only the range of the detector, with intensity."""
    detector_copy = detector.with_params(
        with_values(detector.params, {"fused.use_intensity": use_intensity})
    ).with_sensor_height(height)
    scan, config = make_scan(), detector_copy.proposer.config
    scan = replace(scan, xyz=scan.xyz - np.array([0, 0, height - 1.73], np.float32))
    view = NormalizedView.of(scan, detector_copy.params.ground.sensor_pose, config.low, config.high)
    ground = np.zeros(len(scan), bool)
    ground[view.indices] = segment_view_ground(view.frame, detector_copy.params.ground)
    result = detector_copy(scan)
    assert len(result.detections) > 3 and are_equal_detections(detector_copy(scan, ground=ground), result)


def test_ignored_intensity_equals_missing_intensity(detector):
    """This includes the ground segmentation, which removes low dark points as reflections."""
    scan, blind_detector = make_scan(), copy.copy(detector)
    blind_detector.params = with_values(detector.params, {"fused.use_intensity": False})
    pit_points = np.random.default_rng(0).uniform([4, -4, -2.81], [9, 4, -2.79], (3000, 3))
    scan = PointCloud(
        np.concatenate([scan.xyz, pit_points.astype(np.float32)]),
        np.concatenate([scan.intensity, np.full(3000, 0.5, np.float32)]),
    )
    scan_without_intensity = replace(scan, intensity=None)
    assert (
        "no intensity" in detector(scan_without_intensity).problem
        and blind_detector(scan_without_intensity).problem is None
    )
    assert (
        are_equal_detections(blind_detector(scan), blind_detector(scan_without_intensity))
        and blind_detector(scan).problem is None
    )
    surfaces = [each.propose(scan).surface.heights for each in (blind_detector, detector)]
    np.testing.assert_array_equal(*surfaces)


def test_max_proposals_keeps_the_best_boxes(detector):
    unlimited, limited = copy.copy(detector), copy.copy(detector)
    params = with_values(detector.params, {"fused.classifier_box": 0.0})
    unlimited.params, limited.params = params, with_values(params, {"fused.max_proposals": 9})
    all_proposals = unlimited.propose(make_scan()).detections
    best_proposals = limited.propose(make_scan()).detections  # without the ego vehicle
    assert (
        len(all_proposals) > 100
        and 0 < len(best_proposals) <= 9
        and are_equal_detections(best_proposals, all_proposals[: len(best_proposals)])
    )


def test_classifier_box_weight_interpolates_between_networks(detector):
    def propose(weight: float) -> tuple[np.ndarray, np.ndarray]:
        detector_copy = copy.copy(detector)
        detector_copy.params = with_values(detector.params, {"fused.classifier_box": weight})
        proposals = detector_copy.propose(make_scan())
        return proposals.detections.boxes, np.isfinite(proposals.evidence["classifier"])

    (proposer_boxes, is_classified), (half_boxes, _), (classifier_boxes, _) = (
        propose(weight) for weight in (0.0, 0.5, 1.0)
    )
    assert is_classified.any() and not is_classified.all()
    np.testing.assert_array_equal((proposer_boxes != classifier_boxes).any(axis=1), is_classified)
    np.testing.assert_allclose(half_boxes[:, :6], (proposer_boxes + classifier_boxes)[:, :6] / 2, atol=1e-4)


def test_hills_change_only_the_height_of_boxes():
    """The networks receive points whose ground has been flattened."""
    detector = load_fused_detector("", "cpu", EAGER).with_range("around")
    scan = (
        SimulatedScenes(11, 1, find_sensor("hdl64e", 0.0), Scenes(None, 3.0, "street"), all_around=True)
        .load_frame(0)
        .load()
    )

    def compute_height(xy: np.ndarray) -> np.ndarray:
        return 0.04 * xy[:, 0] + 0.5 * np.sin(xy[:, 1] / 12)

    xyz = scan.xyz + np.outer(compute_height(scan.xyz), [0, 0, 1]).astype(np.float32)
    detections, hilly_detections = detector(scan).detections, detector(replace(scan, xyz=xyz)).detections
    detections = detections[detections.scores > 0.8]
    distances = centre_distances(detections.boxes, hilly_detections.boxes)
    is_matched = distances.min(axis=1) < 0.2
    assert is_matched.sum() > 3 and is_matched.mean() > 0.8
    height_change = (hilly_detections.boxes[distances.argmin(axis=1), 2] - detections.boxes[:, 2])[is_matched]
    np.testing.assert_allclose(height_change, compute_height(detections.boxes)[is_matched], atol=0.1)
    assert np.ptp(height_change) > 0.5


@pytest.mark.parametrize("height, stays", [(0.4, True), (1.0, True), (1.73, False), (6.0, True)])
def test_nearby_car_that_is_not_ego_vehicle_is_kept(detector, monkeypatch, height, stays):
    """The ego vehicle is determined with the actual sensor height instead of 1.73 m."""
    car = Detections.of([[0, 1.4, -0.98, 4, 1.6, 1.5, 0]], CAR, 0.9)  # 0.6 m aside
    monkeypatch.setattr(detector.proposer.__class__, "propose", lambda *_: DetectionResult(car))
    assert len(detector.with_sensor_height(height).propose(make_scan()).detections) == stays


def test_cpu_fallback_of_one_network_is_reported(detector):
    fallback_detector = copy.copy(detector)
    fallback_detector.classifier = copy.copy(detector.classifier)
    fallback_detector.classifier.placement = Placement(CPU, "cuda is out of memory")
    assert fallback_detector(make_scan()).problem == "cuda is out of memory" and detector(make_scan()).problem is None


def test_without_cpu_fallback_the_error_is_raised(detector, monkeypatch):
    """The parameter applies to both networks."""

    def predict(*_, **__):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(classifier, "predict", predict)
    broken_detector = copy.copy(detector)
    broken_detector.classifier = copy.copy(detector.classifier)
    broken_detector.classifier.placement = Placement("meta")
    broken_detector.params = with_values(detector.params, {"fused.cpu_fallback": False})
    with pytest.raises(InputError, match="meta is out of memory"):
        broken_detector(make_scan())


def test_parameters_can_change_between_clouds(detector):
    strict_detector = copy.copy(detector)
    strict_detector.params = with_values(detector.params, {"fused.proposals": 0.6})
    assert len(strict_detector(make_scan()).detections) < len(detector(make_scan()).detections)
    assert are_equal_detections(detector(make_scan()), detector(make_scan()))


def test_clouds_without_usable_intensity_use_separate_curves():
    detector = load_fused_detector("", "cpu", EAGER)
    other_curves = copy.copy(detector)
    other_curves.models = detector.models_without_intensity
    assert other_curves.models != detector.models
    scan = make_scan()
    scan_without_intensity = replace(scan, intensity=None)
    detectors = detector.with_min_score(0.0), other_curves.with_min_score(0.0)
    assert are_equal_detections(*(one(scan_without_intensity) for one in detectors)) and not are_equal_detections(
        *(one(scan) for one in detectors)
    )
    assert are_equal_detections(
        detector(replace(scan, intensity=np.full_like(scan.intensity, 0.3))), detector(scan_without_intensity)
    )
    detector_without_intensity = detector.with_params(with_values(detector.params, {"fused.use_intensity": False}))
    assert are_equal_detections(detector_without_intensity(scan), detector(scan_without_intensity))
    eager_detector = detector.with_min_score(0.01)
    assert len(eager_detector(scan_without_intensity).detections) >= len(detector(scan_without_intensity).detections)
    single_model_detector = FusedDetector(detector.proposer, detector.classifier, detector.params, detector.models)
    assert single_model_detector.models_without_intensity is single_model_detector.models
