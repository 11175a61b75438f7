"""Matching is optimal and one to one, and counts add up."""

from __future__ import annotations

import json
from functools import partial
from itertools import permutations
from pathlib import Path
from types import NoneType

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import CALIBRATION, make_crowd

from experiments.stm_cpa.frames import load_labelled_frame
from lidar_perception.candidates.configurations import PAPER
from lidar_perception.candidates.params import PipelineParams, SeedParams
from lidar_perception.data.frame import Frame, Recording
from lidar_perception.scoring.centres.matching import RANGE_NAMES, Score, find_range_bins, match_centres
from lidar_perception.scoring.centres.report import (
    CandidateReport,
    CandidateResult,
    load_pedestrians,
    measure_candidates,
    measure_frame,
    select_pedestrians,
)
from lidar_perception.scoring.detections import FrameDetections
from lidar_perception.scoring.kitti.report import DetectionReport
from lidar_perception.scoring.run import SkipReason, fill_report, measure_frames
from lidar_perception.types import CLASSES, PEDESTRIAN, Detections, GroundTruth, InputError, PointCloud

seeds = st.integers(0, 2**32 - 1)
small = st.integers(0, 5)


def make_boxes(*centres):
    out = np.zeros((len(centres), 7))
    out[:, :3] = np.reshape(centres, (-1, 3))
    out[:, 3:6] = 1
    return out


def draw_boxes(rng, count, reach=1.2):
    return make_boxes(*rng.uniform(-reach, reach, (count, 3)))


def match_by_brute_force(found, truth, limit):
    """Return the best assignment: most pairs, then smallest distance."""
    if len(found) > len(truth):
        return match_by_brute_force(truth, found, limit)
    best = (0, 0.0)
    for assignment in permutations(range(len(truth)), len(found)):
        d = [np.linalg.norm(found[i, :3] - truth[j, :3]) for i, j in enumerate(assignment)]
        d = [x for x in d if x <= limit]
        best = min(best, (-len(d), sum(d)))
    return -best[0], best[1]


def compute_distances(found, truth, pairs):
    return np.linalg.norm(found[pairs[0], :3] - truth[pairs[1], :3], axis=1)


@given(seeds, small, small, st.sampled_from([0.3, 1.0, 5.0]))
def test_matching_equals_the_best_of_all_assignments(seed, found_count, truth_count, limit):
    rng = np.random.default_rng(seed)
    found, truth = draw_boxes(rng, found_count), draw_boxes(rng, truth_count)
    pairs = match_centres(found, truth, limit)
    count, total = match_by_brute_force(found, truth, limit)
    assert len(pairs[0]) == len(pairs[1]) == count
    assert compute_distances(found, truth, pairs).sum() == pytest.approx(total, abs=1e-9)


def test_maximum_distance_in_3d_is_a_hit():
    truth = make_boxes([10, 5, -1])
    for step in ([1, 0, 0], [0, -1, 0], [0, 0, 1]):
        assert len(match_centres(truth + [*step, 0, 0, 0, 0], truth)[0]) == 1
        assert len(match_centres(truth + [*np.multiply(step, 1.001), 0, 0, 0, 0], truth)[0]) == 0


def test_detections_that_are_not_finite_are_false_positives():
    # Other nodes may send anything; one broken box must not stop the evaluation.
    truth = make_boxes([10, 0, 0], [20, 0, 0])
    found = make_boxes([np.nan, 0, 0], [20.1, 0, 0], [np.inf, 0, 0])
    i, j = match_centres(found, truth)
    assert (i.tolist(), j.tolist()) == ([1], [1])
    score = Score()
    score.update(found, truth)
    everything = score.make_rows()["all"]
    assert (everything["tp"], everything["fp"], everything["fn"]) == (1, 2, 1)


@given(seeds, st.lists(st.tuples(st.integers(0, 12), st.integers(0, 12)), max_size=4))
def test_hits_misses_and_false_positives_add_up(seed, frames):
    rng = np.random.default_rng(seed)
    score, truths, found_count = Score(), [np.zeros((0, 7))], 0
    for found_in_frame, truth_in_frame in frames:
        truth = draw_boxes(rng, truth_in_frame, 70.0)
        truth[:, 2] = 0
        near = truth[rng.random(len(truth)) < 0.5]
        near = near + rng.normal(0, 0.5, near.shape)
        found = np.concatenate([draw_boxes(rng, found_in_frame, 70.0), near]).astype(np.float32)
        score.update(found, truth)
        truths.append(truth)
        found_count += len(found)
    table = score.make_rows()
    by_range = np.bincount(find_range_bins(np.concatenate(truths)), minlength=len(RANGE_NAMES))
    for name, count in zip(RANGE_NAMES, by_range):
        assert table[name]["tp"] + table[name]["fn"] == count
    everything = table["all"]
    assert everything["tp"] + everything["fn"] == by_range.sum()
    assert everything["tp"] + everything["fp"] == found_count
    for count in ("tp", "fp", "fn"):
        assert everything[count] == sum(table[name][count] for name in RANGE_NAMES)
    for row in table.values():
        p, r = row["precision"], row["recall"]
        assert row["f1"] == pytest.approx(2 * p * r / (p + r) if p + r else 0.0)


def test_scores_equal_hand_computed_values():
    score = Score()
    score.update(
        make_boxes([10.3, 0, 0], [20, 0, 0.5], [14.5, 14.5, 0], [61, 0, 0]),
        make_boxes([10, 0, 0], [20, 0, 0], [40, 0, 0]),
    )
    score.update(np.zeros((0, 7), np.float32), make_boxes([5, 0, 0]))
    score.update(make_boxes([0, -50, 0]).astype(np.float32), np.zeros((0, 7)))
    table = score.make_rows()
    counts = {name: tuple(row[k] for k in ("tp", "fp", "fn")) for name, row in table.items()}
    assert counts == {
        "0-15": (1, 0, 1),
        "15-30": (1, 1, 0),
        "30-45": (0, 0, 1),
        "45-60": (0, 1, 0),
        "60+": (0, 1, 0),
        "all": (2, 3, 2),
    }
    everything = table["all"]
    assert everything["precision"] == pytest.approx(2 / 5)
    assert everything["recall"] == pytest.approx(2 / 4)
    assert everything["f1"] == pytest.approx(4 / 9)
    assert everything["centre_error_m"] == pytest.approx(0.4)
    assert table["0-15"]["centre_error_m"] == pytest.approx(0.3)
    assert table["30-45"]["centre_error_m"] is None


def test_hit_counts_in_the_range_of_the_labelled_object():
    score = Score()
    score.update(make_boxes([15.2, 0, 0]), make_boxes([14.8, 0, 0]))
    assert score.make_rows()["0-15"]["tp"] == 1 and score.make_rows()["15-30"]["fp"] == 0


def test_range_begins_at_its_lower_limit():
    at = make_boxes([0, 0, 9], [14.999, 0, 0], [0, 15, 0], [18, -24, 0], [45, 0, 0], [60, 0, 0], [1e4, 0, 0])
    assert [RANGE_NAMES[i] for i in find_range_bins(at)] == ["0-15", "0-15", "15-30", "30-45", "45-60", "60+", "60+"]


def test_ratios_are_0_without_detections_or_labels():
    empty = Score().make_rows()["all"]
    assert empty == dict(tp=0, fp=0, fn=0, precision=0.0, recall=0.0, f1=0.0, centre_error_m=None)


# --- reports -------------------------------------------------------------------------------


def make_scene_points():
    """A floor at -1.7 m and an upright figure at (7, 0)."""
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(-20, 20, (3000, 2)), rng.normal(-1.7, 0.01, 3000)])
    figure = [7, -0.3, -1.64] + rng.random((400, 3)) * [0.1, 0.6, 1.65]
    return np.concatenate([flat, figure]).astype(np.float32)


def make_frame(name, truth):
    return Frame.of(name, PointCloud(make_scene_points()), truth)


def raise_cut_frame():
    raise InputError("frame 3 is cut")


def make_truth(*centres, label="Pedestrian"):
    truth_boxes = make_boxes(*centres)
    truth_boxes[:, 3:6] = [0.6, 0.8, 1.75]
    return GroundTruth.of(truth_boxes, [CLASSES.index(label)] * len(truth_boxes))


def evaluate_frames(frames, source="ground_truth"):
    report, recording = CandidateReport(), Recording(Path("here"), "memory", frames)
    start = partial(measure_candidates, PipelineParams(seed=SeedParams(source=source)))
    fill_report(report, recording, start)
    found = [result for _, result in measure_frames(recording, start)]
    assert len(found) == len(frames)
    return report.compute(), found


HERE = (7.05, 0, -0.82)


def test_report_is_json_and_counts_every_pedestrian():
    content, found = evaluate_frames(
        [
            make_frame("both", make_truth(HERE, (25, 9, -0.8))),
            make_frame("car", make_truth(HERE, label="Car")),
            make_frame("none", None),
            Frame("cut", 0, raise_cut_frame, lambda: make_truth(HERE)),
            make_frame("again", make_truth(HERE)),
        ]
    )
    assert [type(r) for r in found] == [CandidateResult, NoneType, NoneType, SkipReason, CandidateResult]
    assert json.loads(json.dumps(content, allow_nan=False)) == content
    assert content["frames"] == 2 and content["ground_truth"] == 3
    assert content["ground_truth_by_range"] == {"0-15": 2, "15-30": 1, "30-45": 0, "45-60": 0, "60+": 0}
    assert content["skipped"] == ["frame 3 is cut"]
    for stage in ("stage1", "stage2", "final"):
        row = content[stage]["all"]
        assert (row["tp"], row["fp"], row["fn"]) == (2, 0, 1)
        assert row["centre_error_m"] < 0.1
    assert content["ms"]["total"] > 0


def test_pedestrians_of_a_frame_without_seed_are_missed():
    content, (found,) = evaluate_frames([make_frame("far", make_truth((30, 10, -0.8)))])
    assert found.problem and found.boxes and not any(map(len, found.boxes.values()))
    assert content["frames"] == 1 and content["final"]["all"]["fn"] == 1
    assert content["skipped"][0].startswith("far: ")


def test_empty_recording_has_an_empty_report():
    content, _ = evaluate_frames([])
    assert content["frames"] == content["ground_truth"] == 0
    assert json.loads(json.dumps(content, allow_nan=False)) == content


def test_only_pedestrians_count():
    truth = GroundTruth.of(
        make_boxes([1, 0, 0], [2, 0, 0], [3, 0, 0]),
        [PEDESTRIAN, CLASSES.index("Person_sitting"), CLASSES.index("Cyclist")],
    )
    np.testing.assert_array_equal(select_pedestrians(truth), make_boxes([1, 0, 0]))
    assert select_pedestrians(None).shape == (0, 7)


def test_labels_behind_the_camera_do_not_count():
    cloud, truth = make_crowd(0)
    scan, people = PointCloud(cloud[:, :3], cloud[:, 3]), truth.select_class(PEDESTRIAN)
    ahead, behind, around = (
        Frame.of("a", scan, GroundTruth.of(own, [PEDESTRIAN] * len(own)), CALIBRATION)
        for own in (
            people,
            people * [-1, -1, 1, 1, 1, 1, 1],
            np.concatenate([people, people * [-1, -1, 1, 1, 1, 1, 1]]),
        )
    )
    expected, found = measure_frame(ahead, PAPER), measure_frame(around, PAPER)
    np.testing.assert_array_equal(found.truth, people)
    np.testing.assert_array_equal(found.boxes["final"], expected.boxes["final"])
    assert measure_frame(behind, PAPER) is None
    assert len(load_pedestrians(around, view=False)) == 2 * len(people)

    labels = around.truth()
    detections = Detections(labels.boxes.astype(np.float32), labels.class_ids, np.ones(len(labels)))
    report = DetectionReport()
    report.update(FrameDetections("a", labels, detections, CALIBRATION))
    counts = report.compute()["pedestrian_centres"]["of_all"]["all"]
    assert (counts["tp"], counts["fp"], counts["fn"]) == (len(people), 0, 0)

    np.testing.assert_array_equal(load_labelled_frame(around).pedestrians, people)
    with pytest.raises(InputError, match="in the image"):
        load_labelled_frame(behind)
