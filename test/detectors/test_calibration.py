"""Calibrated scores are probabilities in the same order; invalid calibrations are rejected."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from detection_samples import (
    are_equal_detections,
    lower_thresholds,
    make_random_detector,
    make_random_network,
    make_scan,
    make_tiny_config,
)
from hypothesis import given
from hypothesis import strategies as st
from pointnet_samples import make_random_detector as random_pointnet
from samples import write_object_folder

from lidar_perception.detectors.calibration import calibrate_scores, to_raw_score
from lidar_perception.detectors.checkpoint import Header, read_checkpoint, read_header, save_checkpoint, save_header
from lidar_perception.types import CLASSES, Detections, InputError

pytestmark = pytest.mark.usefixtures("one_thread")
LINES = {"Car": (0.6, 0.5), "Pedestrian": (1.4, -0.8)}


@given(st.lists(st.floats(0, 1, width=32), min_size=1, max_size=30), st.floats(0.05, 20), st.floats(-20, 20))
def test_calibration_keeps_order_and_is_invertible(scores, slope, offset):
    lines = {"Car": (slope, offset)}
    scores = np.sort(np.array(scores, np.float32))
    detections = Detections.of(np.ones((len(scores), 7)), CLASSES.index("Car"), scores)
    calibrated = calibrate_scores(detections, lines).scores
    assert (np.diff(calibrated) >= 0).all() and calibrated.dtype == np.float32
    assert ((calibrated >= 0) & (calibrated <= 1)).all()
    uncalibrated_class = Detections.of(detections.boxes, CLASSES.index("Cyclist"), scores)
    np.testing.assert_array_equal(calibrate_scores(uncalibrated_class, lines).scores, scores)
    for score in (0.0, 0.01, 0.3, 0.97, 1.0):
        raw_score = to_raw_score("Car", score, lines)
        assert 0 <= raw_score <= 1
        if 1e-6 < raw_score < 1 - 1e-6:
            neighbours = np.nextafter(np.float32(raw_score), np.float32([0, 1]))  # scores are float32
            low, high = calibrate_scores(Detections.of(np.ones((2, 7)), 0, neighbours), lines).scores
            assert low - 1e-6 <= score <= high + 1e-6


@pytest.mark.parametrize(
    "make",
    [lambda: make_random_detector("v4", lower_thresholds(score=0.0)), random_pointnet],
    ids=["PointPillars", "PointNet"],
)
def test_calibration_does_not_change_the_boxes(make):
    detector, scan = make().with_min_score(0.0), make_scan()
    raw_detections = detector(scan).detections
    (network,) = detector.networks
    network.header = replace(network.header, calibration=LINES)
    detections = detector(scan).detections
    assert len(detections) and are_equal_detections(detections, calibrate_scores(raw_detections, LINES), atol=1e-6)
    assert are_equal_detections(detector.with_raw_scores()(scan), raw_detections)
    median_score = float(np.median(detections.scores))
    # Weak boxes do not suppress strong ones, so a threshold only removes weak boxes.
    strong_detections = detector.with_min_score(median_score)(scan).detections
    assert (
        0 < len(strong_detections) <= len(detections)
        and (strong_detections.scores >= np.float32(median_score) - 1e-6).all()
    )
    best_scores = detector.with_min_score(1.0)(scan).best
    assert len(detector.with_min_score(1.0)(scan).detections) == 0 and set(best_scores) == {*detector.classes}


@pytest.mark.parametrize(
    "calibration",
    [
        {"Car": [0, 1]},
        {"Car": [1]},
        {"Car": [-1, 0]},
        {"Car": None},
        {"Lamp": [1, 0]},
        {"Car": [1, 1e9]},
        {"Car": ["a", 0]},
    ],
)
def test_invalid_calibration_is_rejected(tmp_path, calibration):
    header = Header(make_tiny_config("v0"), calibration=calibration)
    save_checkpoint(tmp_path / "w.safetensors", make_random_network(make_tiny_config("v0")), header)
    with pytest.raises(InputError, match="invalid calibration"):
        read_header(tmp_path / "w.safetensors")


@pytest.mark.parametrize("half", [False, True])
def test_save_header_does_not_change_the_weights(tmp_path, half):
    path, config = tmp_path / "some.safetensors", make_tiny_config()
    save_checkpoint(path, make_random_network(config), Header(config, calibration=LINES), half)
    _, original = read_checkpoint(path, type(config))
    save_header(path, Header(config, calibration={"Car": (1.0, 0.0)}))
    header, stored = read_checkpoint(path, type(config))
    assert header.calibration == {"Car": (1.0, 0.0)} and stored.keys() == original.keys()
    assert all(value.dtype == original[name].dtype and value.equal(original[name]) for name, value in stored.items())
    # scans without enough objects give no calibration, so the file keeps its own
    content = path.read_bytes()
    script = runpy.run_path(str(Path(__file__).parents[2] / "scripts/calibrate_weights.py"))
    result = CliRunner().invoke(script["main"], [str(write_object_folder(tmp_path / "scans", count=1)), str(path)])
    assert result.exit_code == 1 and "too few correct or wrong detections of Car" in result.output
    assert path.read_bytes() == content
