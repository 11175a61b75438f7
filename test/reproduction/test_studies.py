"""Laws of the studies of paper A's open questions."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import crowd_folder

from lidar_perception.candidates.configurations import PAPER
from lidar_perception.candidates.silhouette import (
    compute_cpa_scales,
    count_pixels,
    draw_silhouettes,
)
from lidar_perception.data.open import open_recording
from lidar_perception.param_fields import with_values
from lidar_perception.reproduction import stm_cpa
from lidar_perception.reproduction.studies import STUDIES, adaptive, confidence
from lidar_perception.reproduction.studies.bank import FRONT, SIDE, template_bank
from lidar_perception.reproduction.studies.configurations import WITHOUT
from lidar_perception.reproduction.studies.density import thinned
from lidar_perception.reproduction.variants import Found, best_f1, score

COUNT = 4


@pytest.fixture(scope="module")
def kitti(tmp_path_factory):
    return crowd_folder(tmp_path_factory.mktemp("kitti"), COUNT)


@pytest.fixture(scope="module")
def frames(kitti):
    return open_recording(kitti).frames


def study(name):
    module, attribute = STUDIES[name].split(":")
    return getattr(importlib.import_module(module), attribute)


@pytest.fixture(scope="module")
def records(frames):
    """name -> records of the frames with pedestrians, of the studies that one scan will do for."""
    return {name: [study(name).measure(frames, i) for i in range(COUNT - 1)]
            for name in STUDIES}


@pytest.mark.parametrize("name", [n for n in STUDIES if n != "confidence"])
def test_counts_of_every_variant_add_up(name, records, frames):
    for record, frame in zip(records[name], frames):
        people = int((frame.truth().class_ids == 3).sum())
        for variant, counts in record["variants"].items():
            truth = np.add(counts["tp"], counts["fn"]).sum()
            assert truth == people - (variant in WITHOUT), variant
            scores, hits = np.array(counts["ranked"], float).reshape(-1, 2).T
            assert hits.sum() <= truth and np.isfinite(scores).all()
            assert sum(counts["tp"]) + sum(counts["fp"]) <= len(scores)


@pytest.mark.parametrize("name, variant", [
    ("configurations", "paper, nearest truth"), ("seeds", "paper, nearest truth"),
    ("morphology", "CPA (the paper)"), ("adaptive", "2 in 15-30 m (the paper)"),
    ("geometry", "stretched, yaw"), ("density", "the paper")])
def test_the_papers_variant_of_each_study_is_the_papers_experiment(name, variant, records, frames):
    for i, record in enumerate(records[name]):
        final = stm_cpa.measure(frames, i)["stages"]["final"]
        own = record["variants"][variant]
        assert {k: own[k] for k in ("tp", "fp", "fn")} == {k: final[k] for k in ("tp", "fp", "fn")}


@pytest.mark.parametrize("name", list(STUDIES))
def test_reports_are_made_of_records_and_of_none(name, records):
    for given_ in ([], [{"frame": "x", "skipped": "why"}], records.get(name, [])):
        made = study(name).sections(given_)
        names = [t.name for section in made for t in section.tables]
        assert made and len(names) == len(set(names))
        for section in made:
            for table in section.tables:
                assert all(len(row) == len(table.header) for row in table.rows), table.name


# --- parts ---------------------------------------------------------------------------------


def boxes_at(indices):
    return np.array([[x, y, -0.9, 0.6, 0.6, 1.7, 0] for x, y in indices]).reshape(-1, 7)


def test_a_given_pedestrian_is_neither_found_nor_missed():
    truth = boxes_at([(5, 0), (12, 3)])
    found = Found(boxes_at([(5.1, 0), (20, 0)]), np.array([0.9, 0.8]), 0.5)
    assert (sum(score(found, truth)["tp"]), sum(score(found, truth)["fp"]),
            sum(score(found, truth)["fn"])) == (1, 1, 1)
    without = score(found._replace(given=truth[0]), truth)
    assert (sum(without["tp"]), sum(without["fp"]), sum(without["fn"])) == (0, 1, 1)
    assert without["ranked"] == [[0.8, 0]]


@given(st.integers(0, 2**32 - 1))
def test_the_best_f1_is_that_of_the_best_threshold(seed):
    rng = np.random.default_rng(seed)
    ranked = [[[round(rng.random(), 1), int(rng.random() < 0.4)] for _ in range(rng.integers(6))]
              for _ in range(4)]
    pairs = [pair for frame in ranked for pair in frame]
    truth = sum(hit for _, hit in pairs) + int(rng.integers(1, 4))
    best = 0.0
    for threshold in np.linspace(0, 1, 11):
        kept = [hit for s, hit in pairs if s >= threshold - 1e-9]
        best = max(best, 200 * sum(kept) / (len(kept) + truth))
    assert best_f1(ranked, truth) == pytest.approx(best)


def test_no_pedestrians_no_f1():
    assert best_f1([[]], 0) is None and best_f1([], 3) == 0.0


def test_templates_thin_out_with_range_and_the_side_is_wider():
    bank = template_bank()
    ranges = sorted({r for r, _ in bank})
    assert len(ranges) >= 4
    for view in (FRONT, SIDE):
        counts = [len(bank[r, view].xyz) for r in ranges]
        assert counts == sorted(counts, reverse=True)
    near = ranges[0]
    width = {view: np.ptp(bank[near, view].xyz[:, 1]) for view in (FRONT, SIDE)}
    assert width[SIDE] > width[FRONT]


def test_thinning_keeps_a_part_of_the_points_and_nothing_is_thinned_nearer():
    seed = template_bank()[7.5, SIDE]
    assert thinned(seed, 1.0) is seed and thinned(seed, 0.5) is seed
    counts = []
    for factor in (1.5, 2.0, 3.0, 4.0):
        part = thinned(seed, factor)
        assert {tuple(p) for p in part.xyz.tolist()} <= {tuple(p) for p in seed.xyz.tolist()}
        counts.append(len(part.xyz))
    assert counts == sorted(counts, reverse=True)
    far_away = template_bank()[30.0, SIDE]  # as it is seen from there
    assert len(thinned(seed, 4.0).xyz) == pytest.approx(len(far_away.xyz), rel=0.5)


def test_steps_grow_with_range_and_with_fewer_points():
    steps = adaptive.by_range(np.array([5.0, 15.0, 16.0, 24.0, 40.0, 500.0]))
    assert steps.tolist() == [0, 0, 1, 2, 4, 8]
    assert adaptive.by_points(np.array([1000, 200, 199, 60, 1, 0])).tolist() == [0, 0, 1, 2, 8, 8]


def test_more_copies_fill_a_silhouette_no_less():
    seed = template_bank()[22.5, SIDE]
    fill = []
    for steps in range(4):
        params = with_values(PAPER, {"cpa.steps": steps, "cpa.min_range": 0.0,
                                     "cpa.max_range": 100.0})
        image = draw_silhouettes(seed.xyz, np.array([0, len(seed.xyz)]),
                                 compute_cpa_scales(np.array([22.5]), params.cpa))
        fill.append(int(count_pixels(image)[0]))
    assert fill == sorted(fill)


def test_precision_and_recall_and_reliability_by_hand():
    precision, recall = confidence.precision_recall(np.array([0.1, 0.9, 0.8, 0.5]),
                                                    np.array([0, 1, 0, 1]), 4)
    assert precision.tolist() == [1, 0.5, pytest.approx(2 / 3), 0.5]
    assert recall.tolist() == [0.25, 0.25, 0.5, 0.5]
    assert confidence.precision_recall(np.ones(2), np.zeros(2), 3)[0].tolist() == []
    bins = confidence.reliability(np.array([0.05, 0.07, 0.95, 1.0]), np.array([0, 1, 1, 1]))
    assert bins[0] == (pytest.approx(0.06), 0.5, 2) and bins[9] == (pytest.approx(0.975), 1.0, 2)
    assert bins[5] == (None, None, 0)
