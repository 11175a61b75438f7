"""Average precision: thresholds at evenly spaced recall, and few objects."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidar_perception.scoring.average_precision import average_curve, choose_thresholds, sample_curve

pytestmark = pytest.mark.no_cover  # covered by other tests

few = settings(max_examples=15, database=None)
seeds = st.integers(0, 2**32 - 1)


@few
@given(seeds, st.integers(41, 400))
def test_thresholds_are_scores_at_evenly_spaced_recall(seed, objects):
    rng = np.random.default_rng(seed)
    hits = rng.uniform(0, 1, rng.integers(1, objects + 1))
    thresholds = choose_thresholds(hits, objects)
    assert len(thresholds) <= 41 and (np.diff(thresholds) < 0).all() and np.isin(thresholds, hits).all()
    recall = np.array([(hits >= t).sum() for t in thresholds]) / objects
    # Each threshold is within half a step of its recall; the last hit covers the remaining points.
    np.testing.assert_allclose(recall[:-1], np.arange(len(thresholds) - 1) / 40, atol=1 / objects + 1e-9)
    assert thresholds[-1] == hits.min()


@pytest.mark.parametrize("objects", [1, 2, 7, 40, 41, 1000])
def test_perfect_detections_of_few_objects_have_ap_100(objects):
    thresholds = choose_thresholds(np.linspace(1, 0, objects), objects)
    right = np.ones(len(thresholds))
    assert average_curve(sample_curve(right, objects)) == pytest.approx((100, 100))
    assert average_curve(sample_curve(np.zeros(0), objects)) == (0, 0)
