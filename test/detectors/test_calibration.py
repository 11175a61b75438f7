"""Calibrated scores are probabilities in the same order; invalid calibrations are rejected."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from detection_samples import eager, frame, lively, random_detector, same, tiny
from hypothesis import given
from hypothesis import strategies as st
from pointnet_samples import random_detector as random_pointnet
from samples import object_folder

from lidar_perception.detectors.calibration import calibrate_scores, to_raw_score
from lidar_perception.detectors.checkpoint import Header, read_checkpoint, read_header, save_checkpoint, save_header
from lidar_perception.types import CLASSES, Detections, InputError

pytestmark = pytest.mark.usefixtures("one_thread")
LINES = {"Car": (0.6, 0.5), "Pedestrian": (1.4, -0.8)}


@given(st.lists(st.floats(0, 1, width=32), min_size=1, max_size=30), st.floats(0.05, 20), st.floats(-20, 20))
def test_calibration_keeps_order_and_is_invertible(scores, slope, offset):
    lines = {"Car": (slope, offset)}
    scores = np.sort(np.array(scores, np.float32))
    found = Detections.of(np.ones((len(scores), 7)), CLASSES.index("Car"), scores)
    after = calibrate_scores(found, lines).scores
    assert (np.diff(after) >= 0).all() and after.dtype == np.float32
    assert ((after >= 0) & (after <= 1)).all()
    others = Detections.of(found.boxes, CLASSES.index("Cyclist"), scores)
    np.testing.assert_array_equal(calibrate_scores(others, lines).scores, scores)
    for score in (0.0, 0.01, 0.3, 0.97, 1.0):
        raw = to_raw_score("Car", score, lines)
        assert 0 <= raw <= 1
        if 1e-6 < raw < 1 - 1e-6:
            beside = np.nextafter(np.float32(raw), np.float32([0, 1]))  # scores are float32
            low, high = calibrate_scores(Detections.of(np.ones((2, 7)), 0, beside), lines).scores
            assert low - 1e-6 <= score <= high + 1e-6


@pytest.mark.parametrize(
    "make", [lambda: random_detector("v4", eager(score=0.0)), random_pointnet], ids=["PointPillars", "PointNet"]
)
def test_calibrated_detector_finds_same_boxes(make):
    detector, scan = make().with_min_score(0.0), frame()
    plain = detector(scan).detections
    (network,) = detector.networks
    network.header = replace(network.header, calibration=LINES)
    found = detector(scan).detections
    assert len(found) and same(found, calibrate_scores(plain, LINES), atol=1e-6)
    assert same(detector.with_raw_scores()(scan), plain)
    middle = float(np.median(found.scores))
    # Weak boxes do not suppress strong ones, so a threshold only removes weak boxes.
    strict = detector.with_min_score(middle)(scan).detections
    assert 0 < len(strict) <= len(found) and (strict.scores >= np.float32(middle) - 1e-6).all()
    best = detector.with_min_score(1.0)(scan).best
    assert len(detector.with_min_score(1.0)(scan).detections) == 0 and set(best) == {*detector.classes}


@pytest.mark.parametrize(
    "broken",
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
def test_calibration_that_does_not_rise_is_rejected(tmp_path, broken):
    header = Header(tiny("v0"), calibration=broken)
    save_checkpoint(tmp_path / "w.safetensors", lively(tiny("v0")), header)
    with pytest.raises(InputError, match="invalid calibration"):
        read_header(tmp_path / "w.safetensors")


@pytest.mark.parametrize("half", [False, True])
def test_save_header_keeps_stored_weights(tmp_path, half):
    path, config = tmp_path / "some.safetensors", tiny()
    save_checkpoint(path, lively(config), Header(config, calibration=LINES), half)
    _, before = read_checkpoint(path, type(config))
    save_header(path, Header(config, calibration={"Car": (1.0, 0.0)}))
    header, after = read_checkpoint(path, type(config))
    assert header.calibration == {"Car": (1.0, 0.0)} and after.keys() == before.keys()
    assert all(value.dtype == before[name].dtype and value.equal(before[name]) for name, value in after.items())
    # scans without enough objects give no calibration, so the file keeps its own
    whole = path.read_bytes()
    script = runpy.run_path(str(Path(__file__).parents[2] / "scripts/calibrate_weights.py"))
    result = CliRunner().invoke(script["main"], [str(object_folder(tmp_path / "scans", count=1)), str(path)])
    assert result.exit_code == 1 and "too few correct or wrong detections of Car" in result.output
    assert path.read_bytes() == whole
