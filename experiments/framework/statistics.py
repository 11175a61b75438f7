"""Rates with intervals from a bootstrap over frames (Efron, 1979; percentile method)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from experiments.framework.experiment import Cell, Line

MAX_DRAWS = 4_000_000  # maximum number of frames drawn at once, to limit the memory


@dataclass(frozen=True)
class BootstrapParams:
    """Parameters of bootstrap intervals.

    Attributes:
        replicates: Number of bootstrap samples.
        level: Fraction of the samples within the interval.
    """

    replicates: int = 2000
    level: float = 0.95
    seed: int = 0


def bootstrap(
    counts: np.ndarray, compute: Callable[[np.ndarray], np.ndarray], params: BootstrapParams = BootstrapParams()
) -> np.ndarray:
    """Compute values from counts, with their intervals.

    Args:
        counts: (F, *C) counts of F frames.
        compute: Function from sums of counts over frames (..., *C) to values (..., *V). It returns
            NaN for a value without cases.

    Returns:
        (3, *V) float64: the value for all frames, and the low and high end of its interval; NaN if
        undefined. Samples without cases are ignored.
    """
    counts = np.asarray(counts, np.float64)
    frames, shape = len(counts), counts.shape[1:]
    flat_counts = counts.reshape(frames, int(np.prod(shape)))
    value = np.asarray(compute(flat_counts.sum(axis=0).reshape(shape)), np.float64)
    if frames == 0:
        return np.stack([value, np.full(value.shape, np.nan), np.full(value.shape, np.nan)])
    rng, replicates = np.random.default_rng(params.seed), []
    batch_size = max(1, MAX_DRAWS // frames)
    for start in range(0, params.replicates, batch_size):
        rows = min(batch_size, params.replicates - start)
        # Number of times each frame was drawn, used as the weight of its counts.
        indices = rng.integers(frames, size=(rows, frames)) + frames * np.arange(rows)[:, None]
        weights = np.bincount(indices.ravel(), minlength=rows * frames).reshape(rows, frames)
        replicates.append(compute((weights @ flat_counts).reshape(rows, *shape)))
    limits = _compute_limits(np.concatenate(replicates), params.level)
    return np.stack([value, *np.where(np.isnan(value), np.nan, limits)])


def compute_paired_p(
    counts: np.ndarray, compute: Callable[[np.ndarray], np.ndarray], params: BootstrapParams = BootstrapParams()
) -> np.ndarray:
    """Compute p values of the differences between two methods on the same frames.

    This is a paired permutation test: if the methods are equal, the counts of each frame may be
    swapped. p is the fraction of permutations, including the original one, with a difference at
    least as large in absolute value (Phipson and Smyth, 2010).

    Args:
        counts: (F, 2, *C) counts of both methods.
        compute: See bootstrap().

    Returns:
        (*V) float64; NaN for values without cases, or if there are no frames.
    """
    counts = np.asarray(counts, np.float64)
    frames, shape = len(counts), counts.shape[2:]
    flat_counts = counts.reshape(frames, 2, int(np.prod(shape)))
    total, swap_change = flat_counts.sum(axis=(0, 1)), flat_counts[:, 0] - flat_counts[:, 1]

    def compute_difference(first_sums: np.ndarray) -> np.ndarray:
        rows = first_sums.shape[:-1]
        return compute(first_sums.reshape(*rows, *shape)) - compute((total - first_sums).reshape(*rows, *shape))

    observed_difference = np.abs(compute_difference(flat_counts[:, 0].sum(axis=0)))
    if frames == 0:
        return np.full(observed_difference.shape, np.nan)
    rng, count_at_least = np.random.default_rng(params.seed), np.ones(observed_difference.shape)
    batch_size = max(1, MAX_DRAWS // frames)
    for start in range(0, params.replicates, batch_size):
        is_swapped = rng.random((min(batch_size, params.replicates - start), frames)) < 0.5
        differences = np.abs(compute_difference(flat_counts[:, 0].sum(axis=0) - is_swapped @ swap_change))
        count_at_least += (differences >= observed_difference - 1e-12).sum(axis=0)
    return np.where(np.isnan(observed_difference), np.nan, count_at_least / (params.replicates + 1))


def estimate(draws: np.ndarray, level: float = BootstrapParams.level) -> np.ndarray:
    """Return values with their intervals (3, *V), as bootstrap() does, from values of samples.

    Args:
        draws: (1 + R, *V) values of all frames, then of R samples of the frames; NaN if undefined.
    """
    if len(draws) == 1:
        return np.stack([draws[0], *np.full((2, *draws[0].shape), np.nan)])
    return np.stack([draws[0], *np.where(np.isnan(draws[0]), np.nan, _compute_limits(draws[1:], level))])


def compute_sampled_p(draws: np.ndarray) -> float:
    """Return the two-sided p value of a difference, for the hypothesis that it is 0.

    It is twice the fraction of the samples on the other side of 0, at least 2 / (R + 1).

    Args:
        draws: (1 + R,) differences between two methods on the same frames, see estimate().

    Returns:
        The p value; NaN if there are no samples.
    """
    samples = draws[1:][~np.isnan(draws[1:])]
    if len(samples) == 0 or np.isnan(draws[0]):
        return np.nan
    smaller_side = min((samples <= 0).sum(), (samples >= 0).sum())
    return float(min(1.0, 2 * (smaller_side + 1) / (len(samples) + 1)))


def _compute_limits(replicates: np.ndarray, level: float) -> np.ndarray:
    """Return the ends (2, *V) of the interval of replicates (R, *V), NaN where all replicates are NaN."""
    is_all_nan = np.isnan(replicates).all(axis=0)
    ends = np.nanpercentile(
        np.where(is_all_nan, 0.0, replicates),  # avoids NumPy's warning about all-NaN columns
        [50 - 50 * level, 50 + 50 * level],
        axis=0,
    )
    return np.where(is_all_nan, np.nan, ends)


def divide(numerator: np.ndarray, denominator: np.ndarray) -> np.ndarray:
    """Return numerator / denominator, or NaN where the denominator is 0."""
    numerator, denominator = np.broadcast_arrays(np.asarray(numerator, float), np.asarray(denominator, float))
    return np.divide(numerator, denominator, out=np.full(numerator.shape, np.nan), where=denominator != 0)


def compute_rates(tp: np.ndarray, fp: np.ndarray, fn: np.ndarray) -> np.ndarray:
    """Compute recall, precision and F1 (..., 3), in percent, from counts (...,). NaN if there are no cases."""
    return 100 * np.stack([divide(tp, tp + fn), divide(tp, tp + fp), divide(2 * tp, 2 * tp + fp + fn)], axis=-1)


def make_cells(
    estimates: np.ndarray, paper: Iterable[float | None] = (), digits: int | Iterable[int] = 1
) -> tuple[Cell, ...]:
    """Convert the estimates (3, V) of bootstrap() to cells.

    Args:
        paper: The paper's values in the same order; empty if unknown.
        digits: Number of decimals of each value, or one number for all.
    """
    count = estimates.shape[1]
    paper = [*paper] or [None] * count
    digits = [digits] * count if isinstance(digits, int) else [*digits]
    return tuple(
        Cell(value, low, high, paper_value, decimals)
        for (value, low, high), paper_value, decimals in zip(map(nan_to_none, estimates.T), paper, digits, strict=True)
    )


def make_line(label: str, x: Iterable[float], estimates: np.ndarray) -> Line:
    """Convert the estimates (3, X) of bootstrap() to a curve with its interval."""
    value, low, high = map(nan_to_none, estimates)
    return Line(label, tuple(x), value, low, high)


def stack_counts(rows: list, *shape: int) -> np.ndarray:
    """Stack one entry per frame to an array (F, *shape) float64. F may be 0."""
    return np.array(rows, np.float64).reshape(len(rows), *shape)


def nan_to_none(values: Iterable[float]) -> list[float | None]:
    """Return the values as a list of floats, with None for NaN."""
    return [None if np.isnan(v) else float(v) for v in values]
