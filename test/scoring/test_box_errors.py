"""Box errors: known differences are measured correctly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import expit, logit

from lidar_perception.classes import CAR
from lidar_perception.scoring.kitti.box_errors import ERRORS, RANGES, measure_box_errors
from lidar_perception.scoring.kitti.camera_objects import to_camera_objects, to_scored_labels
from lidar_perception.scoring.kitti.protocol import Comparison, compare_objects
from lidar_perception.scoring.kitti.reliability import fit_calibrations, measure_reliability
from lidar_perception.types import Detections, GroundTruth


def make_frame(true: np.ndarray, found: np.ndarray, scores=0.9):
    truth = GroundTruth.of(true, np.full(len(true), CAR))
    detections = Detections.of(found, CAR, scores)
    return compare_objects(to_camera_objects(truth, None), to_camera_objects(to_scored_labels(detections), None))


def make_cars(count: int, rng) -> np.ndarray:
    """Return cars on a spiral that do not touch each other."""
    way, away = np.linspace(-1, 1, count), np.linspace(8, 70, count)
    return np.column_stack(
        [
            away * np.cos(way),
            away * np.sin(way),
            np.full(count, -0.9),
            np.tile([4.0, 1.7, 1.5], (count, 1)),
            rng.uniform(-3, 3, count),
        ]
    )


def shift_boxes(boxes: np.ndarray, away=0.0, aside=0.0, **sizes) -> np.ndarray:
    """Shift boxes along the ray and to its left, and change sizes while the bottoms stay in place."""
    azimuth = np.arctan2(boxes[:, 1], boxes[:, 0])
    off = boxes.copy()
    off[:, 0] += np.cos(azimuth) * away - np.sin(azimuth) * aside
    off[:, 1] += np.sin(azimuth) * away + np.cos(azimuth) * aside
    off[:, 3] += sizes.get("length", 0)
    off[:, 5] += sizes.get("height", 0)
    off[:, 2] += sizes.get("height", 0) / 2 + sizes.get("bottom", 0)
    off[:, 6] += np.pi + sizes.get("yaw", 0)  # front and rear are the same box
    return off


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_scores_equal_to_the_precision_are_reliable(seed):
    rng = np.random.default_rng(seed)
    true = make_cars(400, rng)
    true[:, :2] *= 20  # far apart
    share = rng.uniform(0.05, 1, 400)
    found = true.copy()
    found[rng.random(400) >= share] += [1e4, 0, 0, 0, 0, 0, 0]
    honest, modest = (
        measure_reliability(Comparison.concatenate([make_frame(true, found, scores)]), "Car")
        for scores in (share, 0.05 + share / 10)
    )
    assert sum(row["boxes"] for row in honest["bins"]) == 400
    assert honest["error"] < 12 and modest["error"] > 30
    assert measure_reliability(Comparison.concatenate([make_frame(true, found[:0])]), "Car")["error"] is None


@settings(max_examples=5)
@given(st.integers(0, 2**32 - 1))
def test_fitted_calibration_recovers_distorted_scores(seed):
    rng = np.random.default_rng(seed)
    true = make_cars(3000, rng)
    true[:, :2] *= 200
    share = rng.uniform(0.02, 0.98, 3000)
    found = true.copy()
    found[rng.random(3000) >= share] += [1e6, 0, 0, 0, 0, 0, 0]
    bent = expit((logit(share) + 0.7) / 1.6)
    slope, offset = fit_calibrations(
        Comparison.concatenate([make_frame(true[i::30], found[i::30], bent[i::30]) for i in range(30)])
    )["Car"]
    assert slope == pytest.approx(1.6, abs=0.25) and offset == pytest.approx(-0.7, abs=0.25)
    assert fit_calibrations(Comparison.concatenate([make_frame(true[:5], found[:5], bent[:5])])) == {}


def test_known_box_errors_are_measured():
    true = make_cars(20, np.random.default_rng(0))
    made = dict(away=0.12, aside=-0.07, bottom=0.1, length=-0.2, width=0.0, height=0.06, yaw=0.05)
    errors = measure_box_errors([make_frame(true, shift_boxes(true, **made))], "Car", 0.2)
    for title, row in errors["by_range"].items():
        for name in ERRORS:
            assert row[name]["median"] == pytest.approx(made[name], abs=1e-5), (title, name)
            assert row[name]["median_size"] == pytest.approx(abs(made[name]), abs=1e-5)
    counts = [row["pairs"] for row in errors["by_range"].values()]
    assert len(counts) == len(RANGES) and sum(counts[:-1]) == counts[-1] == 20


def test_weak_boxes_and_classes_without_boxes_have_no_errors():
    true = make_cars(12, np.random.default_rng(1))
    scores = np.full(12, 0.9)
    scores[11] = 0.1
    assert measure_box_errors([make_frame(true, shift_boxes(true), scores)], "Car")["by_range"]["all"]["pairs"] == 11
    assert measure_box_errors([make_frame(true, true[:0])], "Car")["by_range"]["all"]["yaw"]["median"] is None
    assert measure_box_errors([], "Pedestrian")["by_range"]["all"]["pairs"] == 0
