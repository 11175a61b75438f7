"""The range `around`: two passes of a network trained for `ahead`."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pointnet_samples
import pytest
from detection_samples import are_equal_detections, make_detector, make_random_detector, make_tiny_config

from lidar_perception.classes import CAR
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.detectors.checkpoint import Header
from lidar_perception.detectors.normalized_view import rotate_boxes_half_turn, rotate_half_turn
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.pointnet.detector import PointNetDetector
from lidar_perception.detectors.pointpillars.config import HALF, RANGES
from lidar_perception.detectors.pointpillars.params import EXPERT_CLUSTERING, EXPERT_GROUND
from lidar_perception.detectors.weights_file import POINTPILLARS_WEIGHTS
from lidar_perception.geometry import horizontal_range
from lidar_perception.ground.segment import segment_ground
from lidar_perception.scoring.centres.matching import match_centres
from lidar_perception.simulation.drive import simulate_scan
from lidar_perception.simulation.sensor import HDL64E
from lidar_perception.types import InputError, PointCloud

pytestmark = pytest.mark.usefixtures("one_thread")


def open_shipped(version="v4", range="auto"):
    return open_detector(
        POINTPILLARS_WEIGHTS / f"pointpillars_{version}_compact.safetensors", "cpu", min_score=0.05, range=range
    )


def compute_columns(scan):
    """Return the ground and cluster columns of a cloud. For a rotated cloud they would differ slightly."""
    ground = segment_ground(scan, EXPERT_GROUND)
    return {"ground": ground, "cluster_ids": cluster_obstacles(scan.xyz, ground, EXPERT_CLUSTERING)}


@pytest.fixture(scope="module")
def street(streets):
    return simulate_scan(12, 0, HDL64E)


@pytest.mark.parametrize("version", ["v0", "v4"])
def test_rotated_cloud_has_rotated_boxes(version, street):
    detector = open_shipped(version, "around")
    columns = compute_columns(street.frame)
    detections = detector(street.frame, **columns).detections
    rotated_detections = detector(rotate_half_turn(street.frame), **columns).detections
    assert min((detections.boxes[:, 0] > 3).sum(), (detections.boxes[:, 0] < -3).sum()) > 3
    assert are_equal_detections(
        rotated_detections, replace(detections, boxes=rotate_boxes_half_turn(detections.boxes)), atol=1e-4
    )


def test_clear_cars_are_found_behind_and_at_the_sides(street):
    truth = street.truth
    is_clear = np.array([e["num_points"] > 100 and e["visible"] > 0.5 for e in truth.extras])
    angle = np.degrees(np.arctan2(truth.boxes[:, 1], truth.boxes[:, 0]))
    is_near = horizontal_range(truth.boxes) < 30
    cars = truth.boxes[(truth.class_ids == CAR) & is_clear & is_near & (np.abs(angle) > 60)]
    detections = open_detector("fused", "cpu", range="around")(street.frame).detections
    detected_cars = detections.boxes[detections.class_ids == CAR]
    with pytest.raises(InputError, match="'Around'; did you mean 'around'"):
        open_detector("fused", "cpu", range="Around")
    assert len(cars) >= 4
    assert len(match_centres(detected_cars[:, :3], cars[:, :3], 1.0)[0]) >= 0.8 * len(cars)


def test_range_around_equals_single_pass_away_from_border(street):
    detector, columns = open_shipped(), compute_columns(street.frame)
    half_header = replace(detector.proposer.header, config=replace(detector.proposer.config, **HALF))
    single_pass = make_detector(detector.proposer.network, half_header, detector.params)
    detections = [
        ahead_detections[np.flatnonzero(ahead_detections.boxes[:, 0] > 8)]
        for ahead_detections in (
            one_detector(street.frame, **columns).detections
            for one_detector in (single_pass, detector.with_range("around"))
        )
    ]
    assert len(detections[0]) > 3 and are_equal_detections(*detections)


def test_range_can_be_changed_and_restored(street):
    detector = open_shipped("v1")
    around = detector.with_range("around")
    assert detector.with_range("auto") is detector.with_range("ahead") is detector
    assert around.with_range("around") is around
    assert around.proposer.config.low == RANGES["around"]["low"]
    assert are_equal_detections(around.with_range("ahead")(street.frame), detector(street.frame))
    around_detector = make_random_detector(**RANGES["around"])  # one pass is enough
    assert around_detector.with_range("around") is around_detector and len(around_detector.proposer.half_turns) == 1


def test_range_around_accepts_empty_half_and_empty_cloud(street):
    detector = open_shipped(range="around")
    ahead_result = detector(street.frame.take(np.flatnonzero(street.frame.xyz[:, 0] > 6)))
    assert len(ahead_result.detections) and ahead_result.problem is None
    empty_result = detector(PointCloud.of(np.zeros((0, 3))))
    assert len(empty_result.detections) == 0 and "empty" in empty_result.problem


def test_unsupported_range_is_rejected():
    config = pointnet_samples.make_small_config()
    pointnet = PointNetDetector(
        pointnet_samples.make_classifier(pointnet_samples.make_random_network(config), Header(config))
    )
    assert pointnet.with_range("around") is pointnet
    with pytest.raises(InputError, match="pointnet always covers all directions"):
        pointnet.with_range("ahead")
    with pytest.raises(InputError, match="does not support the range around: a grid of"):
        make_random_detector(low=(0.0, -3.52, -3.0), high=(7.04, 3.52, 1.0), cell=0.22).with_range("around")
    exported = make_detector(SimpleNamespace(has_fixed_range=True), Header(make_tiny_config()))
    with pytest.raises(InputError, match="use the checkpoint for the range around"):
        exported.with_range("around")
