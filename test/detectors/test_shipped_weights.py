"""Shipped weights are small, have a model card, and detect objects in a simulated street."""

from __future__ import annotations

import numpy as np
import pytest

from lidar_perception.classes import CAR
from lidar_perception.data.open import open_recording
from lidar_perception.detectors.boxes import MARGIN_M
from lidar_perception.detectors.checkpoint import read_header
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.weights_file import POINTNET_WEIGHTS, POINTPILLARS_WEIGHTS, find_classifier_weights
from lidar_perception.param_fields import with_values
from lidar_perception.scoring.centres.matching import match_centres
from lidar_perception.simulation.drive import simulate_scan
from lidar_perception.simulation.sensor import HDL64E
from lidar_perception.types import CLASSES

# covered by other tests
pytestmark = [pytest.mark.no_cover, pytest.mark.usefixtures("one_thread", "streets")]
FILES = [*sorted(POINTPILLARS_WEIGHTS.glob("*.safetensors")), POINTNET_WEIGHTS, find_classifier_weights()]
MOST = {"pointpillars": 30e6, "pointnet": 6e6}  # bytes of all files


def test_shipped_weights_exist_and_are_small():
    assert (POINTPILLARS_WEIGHTS / "pointpillars_v4_compact.safetensors") in FILES  # the default
    for network, max_size in MOST.items():
        assert 0 < sum(f.stat().st_size for f in FILES if read_header(f).network == network) < max_size


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_shipped_headers_have_training_and_metrics(file):
    card = file.with_suffix(".md").read_text()
    for text in (
        "Training data: sim",
        "Classes:",
        "Range:",
        "Sensor:",
        "AP in percent",
        "## Known failures",
        "## Licence",
    ):
        assert text in card
    header = read_header(file)
    assert header.training["data"] == ["sim"] and header.metrics["score"] > 0
    assert str(header.training["steps"]) in card and header.commit in card


@pytest.fixture(scope="module")
def scans(streets):
    return [simulate_scan(street, 0, HDL64E) for street in (0, 64, 65)]


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_each_network_finds_most_clear_cars(file, scans):
    detector = open_detector(file, "cpu")
    car_count = hits = 0
    for scan in scans[2:] if "full" in file.stem else scans[1:]:  # full-size networks are slow
        is_car = scan.truth.class_ids == CLASSES.index("Car")
        is_clear = np.array([e["num_points"] > 100 and e["visible"] > 0.5 for e in scan.truth.extras])
        is_ahead = (scan.truth.boxes[:, 0] > 5) & (scan.truth.boxes[:, 0] < 35) & (np.abs(scan.truth.boxes[:, 1]) < 20)
        boxes = scan.truth.boxes[is_car & is_clear & is_ahead]
        detections = detector(scan.frame).detections
        detected_cars = detections.boxes[detections.class_ids == CLASSES.index("Car")]
        car_count += len(boxes)
        hits += len(match_centres(detected_cars[:, :3], boxes[:, :3], 1.0)[0])
    assert car_count >= 4 and hits >= 0.7 * car_count


@pytest.mark.parametrize("name", ["pointnet", "fused"])
def test_only_boxes_of_cars_are_moved_to_their_points(name, scans):
    detector = open_detector(name, "cpu")
    results = []
    for weight in (0.0, 1.0):
        detector.params = with_values(detector.params, {f"{name}.on_points": weight})
        results.append(detector(scans[0].frame).detections)
    original_boxes, moved_boxes = results
    is_car = original_boxes.class_ids == CAR
    distances = np.hypot(*(moved_boxes.boxes - original_boxes.boxes)[:, :2].T)
    assert 0.02 < distances[is_car].max() <= MARGIN_M * 2**0.5 + 1e-5 and not distances[~is_car].any()
    np.testing.assert_array_equal(moved_boxes.boxes[:, 3:], original_boxes.boxes[:, 3:])
    np.testing.assert_array_equal(moved_boxes.scores, original_boxes.scores)


def test_ego_vehicle_is_not_detected(data):
    """Full scans of KITTI contain some points of the vehicle's roof."""
    frames = [frame for frame in open_recording(data / "kitti_object") if (frame.load().xyz[:, 0] < -5).any()][:3]
    for detector in open_detector("fused", "cpu", range="around"), open_detector("pointnet", "cpu"):
        for frame in frames:
            detections = detector(frame.load()).detections
            cars = detections.boxes[detections.class_ids == CAR]
            assert (np.hypot(cars[:, 0], cars[:, 1]) > 2.0).all()
