"""The threshold with the best F1, and its scores."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import CALIBRATION

from lidar_perception.scoring.centres.matching import match_centres
from lidar_perception.scoring.centres.scores import CentreScores
from lidar_perception.scoring.detections import FrameDetections
from lidar_perception.scoring.kitti.report import DetectionReport
from lidar_perception.types import PEDESTRIAN, Detections, GroundTruth

pytestmark = pytest.mark.no_cover  # covered by other tests
seeds = st.integers(0, 2**32 - 1)


def find_best_f1_slowly(scores):
    """Return the highest F1 over all scores as thresholds."""
    return max(scores.make_rows(s)["all"]["f1"] for _, _, found in scores.frames for s in found)


@given(seeds)
def test_best_score_is_the_maximum_of_all_scores(seed):
    rng = np.random.default_rng(seed)
    scores = CentreScores()
    for _ in range(6):
        truth, found = (np.column_stack([rng.uniform(-2, 2, (n, 3)), np.ones((n, 4))]) for n in rng.integers(1, 6, 2))
        scores.update(truth, found, rng.integers(0, 3, len(found)) / 2)
    best = scores.make_rows(scores.find_best_score())["all"]["f1"]
    assert best == pytest.approx(find_best_f1_slowly(scores))
    assert scores.compute()["of_all"]["all"]["tp"] == sum(
        len(match_centres(found, truth)[0]) for truth, found, _ in scores.frames
    )


def test_detections_of_equal_score_share_a_threshold():
    # Threshold 0.9: 2 * 1 / (1 + 2). Threshold 0.5: 2 * 2 / (5 + 2). Equal scores are kept together.
    scores, person, wrong = CentreScores(), np.array([[10.0, 0, 0, 1, 1, 1, 0]]), np.ones((3, 7))
    scores.update(person, person, np.array([0.9]))
    scores.update(person, np.concatenate([person, wrong]), np.full(4, 0.5))
    assert scores.find_best_score() == 0.9


def test_ap_by_centre_distance_equals_hand_computed_value():
    total = DetectionReport()
    person = np.array([10.0, 0, -0.8, 0.8, 0.6, 1.7, 0])
    truth = GroundTruth.of([person, person + [0, 4, 0, 0, 0, 0, 0]], [PEDESTRIAN] * 2)
    near, far, behind = (person + [dx, 0, 0, 0, 0, 0, 0] for dx in (0.9, 1.1, -30))
    found = Detections.of([near, far, behind], PEDESTRIAN, [0.8, 0.3, 0.9])
    total.update(FrameDetections("a", truth, found, CALIBRATION))
    total.update(FrameDetections("no pedestrian", GroundTruth.of([], []), found, CALIBRATION))
    content = total.compute()["pedestrian_centres"]
    assert (content["frames"], content["ground_truth"]) == (1, 2)
    # Only the near detection is a hit; boxes behind the camera do not count: 2 * 1 / (2 + 2)
    assert content["of_all"]["all"]["f1"] == 0.5
    assert content["best_score"] == pytest.approx(0.8)  # 2 * 1 / (1 + 2)
    assert content["at_best_score"]["all"]["f1"] == pytest.approx(2 / 3)
