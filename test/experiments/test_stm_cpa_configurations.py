"""The configurations `paper` and `best`: counts, exclusion of the seed, and best threshold."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import write_crowd_folder

from experiments.stm_cpa import experiment
from experiments.stm_cpa.configurations import (
    CONFIGURATIONS,
    WITHOUT_SEED,
    ScoredBoxes,
    drop_seed_pedestrian,
    find_best_f1,
    score_boxes,
)
from lidar_perception.data.open import open_recording

COUNT = 4


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    return open_recording(write_crowd_folder(tmp_path_factory.mktemp("kitti"), COUNT)).frames


@pytest.fixture(scope="module")
def records(frames):
    """Records of the frames with pedestrians."""
    return [CONFIGURATIONS.measure(frames, i) for i in range(COUNT - 1)]


def test_counts_of_every_variant_add_up(records, frames):
    for record, frame in zip(records, frames):
        people = int((frame.truth().class_ids == 3).sum())
        for variant, counts in record["variants"].items():
            truth = np.add(counts["tp"], counts["fn"]).sum()
            assert truth == people - (variant in WITHOUT_SEED), variant
            scores, hits = np.array(counts["ranked"], float).reshape(-1, 2).T
            assert hits.sum() <= truth and np.isfinite(scores).all()
            assert sum(counts["tp"]) + sum(counts["fp"]) <= len(scores)


def test_paper_variant_equals_the_experiment_of_the_paper(records, frames):
    for i, record in enumerate(records):
        final = experiment.measure_frame(frames, i)["stages"]["final"]
        own = record["variants"]["paper, nearest truth"]
        assert {k: own[k] for k in ("tp", "fp", "fn")} == {k: final[k] for k in ("tp", "fp", "fn")}


def test_report_is_complete_with_and_without_records(records):
    for some in ([], [{"frame": "x", "skipped": "why"}], records):
        sections = CONFIGURATIONS.make_sections(some)
        tables = [table for section in sections for table in section.tables]
        assert len(tables) == len({table.name for table in tables}) == 4
        for table in tables:
            assert all(len(row) == len(table.header) for row in table.rows), table.name


def make_boxes_at(places):
    return np.array([[x, y, -0.9, 0.6, 0.6, 1.7, 0] for x, y in places]).reshape(-1, 7)


def test_seed_pedestrian_is_not_counted():
    truth = make_boxes_at([(5, 0), (12, 3)])
    found = ScoredBoxes(make_boxes_at([(5.1, 0), (20, 0)]), np.array([0.9, 0.8]), 0.5)
    counts = score_boxes(found, truth)
    assert [sum(counts[k]) for k in ("tp", "fp", "fn")] == [1, 1, 1]
    without = score_boxes(*drop_seed_pedestrian(found, truth, truth[0]))
    assert [sum(without[k]) for k in ("tp", "fp", "fn")] == [0, 1, 1]
    assert without["ranked"] == [[0.8, 0]]


@given(st.integers(0, 2**32 - 1))
def test_best_f1_is_that_of_the_best_threshold(seed):
    rng = np.random.default_rng(seed)
    ranked = [[[round(rng.random(), 1), int(rng.random() < 0.4)] for _ in range(rng.integers(6))] for _ in range(4)]
    pairs = [pair for frame in ranked for pair in frame]
    truth = sum(hit for _, hit in pairs) + int(rng.integers(1, 4))
    best = 0.0
    for threshold in np.linspace(0, 1, 11):
        hits = [hit for score, hit in pairs if score >= threshold - 1e-9]
        best = max(best, 200 * sum(hits) / (len(hits) + truth))
    assert find_best_f1(ranked, truth) == pytest.approx(best)


def test_best_f1_needs_pedestrians():
    assert find_best_f1([[]], 0) is None and find_best_f1([], 3) == 0.0
