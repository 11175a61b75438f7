"""Properties of the bootstrap over frames."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.framework.statistics import (
    BootstrapParams,
    bootstrap,
    compute_rates,
    divide,
    make_cells,
    nan_to_none,
    stack_counts,
)

seeds = st.integers(0, 2**32 - 1)


def compute_fraction(sums):
    return divide(sums[..., :1], sums[..., :1] + sums[..., 1:])


def draw_hits(frames, rate, rng):
    """Hits and misses (F, 2) with one case per frame."""
    hit = rng.uniform(size=frames) < rate
    return np.column_stack([hit, ~hit])


@given(seeds, st.integers(30, 300), st.floats(0.2, 0.8))
def test_interval_contains_the_value(seed, frames, rate):
    rng = np.random.default_rng(seed)
    counts = rng.poisson(3, (frames, 2)) * [rate, 1 - rate]
    value, low, high = bootstrap(counts, compute_fraction)
    assert (low < value).all() and (value < high).all()
    assert value[0] == pytest.approx(counts[:, 0].sum() / counts.sum())


@given(seeds, st.floats(0.2, 0.8))
def test_interval_of_a_fraction_agrees_with_binomial(seed, rate):
    counts = draw_hits(1000, rate, np.random.default_rng(seed))
    (value,), (low,), (high,) = bootstrap(counts, compute_fraction)
    expected = 2 * 1.96 * np.sqrt(value * (1 - value) / 1000)
    assert high - low == pytest.approx(expected, rel=0.12)
    assert (low + high) / 2 == pytest.approx(value, abs=0.1 * expected)


def test_four_times_the_frames_halve_the_interval():
    counts = draw_hits(500, 0.4, np.random.default_rng(5))
    narrow, wide = (np.ptp(bootstrap(np.tile(counts, (n, 1)), compute_fraction)[1:]) for n in (4, 1))
    assert wide / narrow == pytest.approx(2.0, rel=0.1)


def test_interval_covers_truth_at_its_level():
    rng = np.random.default_rng(0)
    params = BootstrapParams(replicates=400)
    inside = 0
    for _ in range(200):
        # Cases of a frame are correlated, so an interval for independent cases would be too narrow.
        rate = rng.beta(4, 4, size=120)
        cases = rng.poisson(5, size=120)
        found = rng.binomial(cases, rate)
        _, (low,), (high,) = bootstrap(np.column_stack([found, cases - found]), compute_fraction, params)
        inside += low <= 0.5 <= high
    assert 0.90 <= inside / 200 <= 0.99


def test_bootstrap_weights_sum_to_the_number_of_blocks():
    """Sums of one-hot frames count how often each frame was drawn."""
    counts = np.eye(6)
    sums_of_calls = []
    bootstrap(counts, lambda sums: sums_of_calls.append(sums) or sums[..., :1])
    drawn = sums_of_calls[1]
    assert drawn.shape == (BootstrapParams().replicates, 6) and (drawn.sum(axis=1) == 6).all()
    assert (drawn == drawn.astype(int)).all()
    np.testing.assert_allclose(drawn.mean(axis=0), 1, atol=0.1)
    assert drawn.var() == pytest.approx(5 / 6, abs=0.05)  # multinomial: n p (1 - p)


@pytest.mark.parametrize("counts", [np.full((50, 2), 3), [[7, 2]], [[0, 0], [4, 4], [0, 0]]])
def test_equal_frames_give_an_interval_of_zero_width(counts):
    value, low, high = bootstrap(np.array(counts), compute_fraction)
    assert value == low == high == pytest.approx(np.sum(counts, axis=0)[0] / np.sum(counts))


@pytest.mark.parametrize("counts", [np.zeros((0, 2)), np.zeros((8, 2))])
def test_value_without_cases_is_missing(counts):
    assert np.isnan(bootstrap(counts, compute_fraction)).all()
    (cell,) = make_cells(bootstrap(counts, compute_fraction))
    assert (cell.value, cell.low, cell.high, cell.paper) == (None, None, None, None)


def test_interval_depends_on_seed_and_not_on_block_size(monkeypatch):
    counts = np.random.default_rng(1).poisson(3, (40, 2))
    first = bootstrap(counts, compute_fraction)
    np.testing.assert_array_equal(first, bootstrap(counts, compute_fraction))
    assert not np.array_equal(first, bootstrap(counts, compute_fraction, BootstrapParams(seed=1)))
    monkeypatch.setattr("experiments.framework.statistics.MAX_DRAWS", 130)
    np.testing.assert_array_equal(first, bootstrap(counts, compute_fraction))


def test_intervals_of_an_array_equal_those_of_its_elements():
    counts = np.random.default_rng(2).poisson(2, (60, 3, 4))
    together = bootstrap(counts, lambda sums: compute_rates(*np.moveaxis(sums, -2, 0)))
    assert together.shape == (3, 4, 3)
    for k in range(4):
        single = bootstrap(counts[:, :, k], lambda sums: compute_rates(*np.moveaxis(sums, -1, 0)))
        np.testing.assert_allclose(together[:, k], single)


@given(st.integers(0, 50), st.integers(0, 50), st.integers(0, 50))
def test_rates_are_recall_precision_and_f1(tp, fp, fn):
    recall, precision, f1 = nan_to_none(compute_rates(np.array(tp), np.array(fp), np.array(fn)))
    assert (recall is None) == (tp + fn == 0) and (precision is None) == (tp + fp == 0)
    assert (f1 is None) == (tp + fp + fn == 0)
    if tp:
        assert f1 == pytest.approx(2 * recall * precision / (recall + precision))
    elif f1 is not None:
        assert f1 == 0


def test_cells_contain_paper_value_and_number_of_decimals():
    estimates = np.array([[1.0, np.nan], [0.5, np.nan], [2.0, np.nan]])
    first, second = make_cells(estimates, (3.0, None), (1, 2))
    assert (first.value, first.low, first.high, first.paper, first.digits) == (1, 0.5, 2, 3, 1)
    assert (second.value, second.paper, second.digits) == (None, None, 2)
    with pytest.raises(ValueError, match="shorter"):
        make_cells(estimates, (3.0,))


def test_counts_of_no_frames_keep_their_shape():
    assert stack_counts([], 2, 3).shape == (0, 2, 3)
    assert stack_counts([[1, 2]], 2).tolist() == [[1, 2]]
