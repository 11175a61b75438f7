"""Rates with intervals: the bootstrap by frame (Efron, 1979; percentile method)."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from lidar_perception.reproduction.experiment import Cell, Line
from lidar_perception.reproduction.params import BootstrapParams

DRAWN = 4_000_000  # frames drawn at once; bounds the memory


def bootstrap(counts: np.ndarray, values: Callable[[np.ndarray], np.ndarray],
              params: BootstrapParams = BootstrapParams()) -> np.ndarray:
    """(3, *V) float64: value, low and high end of the interval; NaN where there is none.

    counts (F, *C) of F frames; values takes sums of counts over frames (..., *C) to figures
    (..., *V), NaN where a figure has no cases. A replicate without cases is left out; the value
    is that of all frames.
    """
    counts = np.asarray(counts, np.float64)
    frames, shape = len(counts), counts.shape[1:]
    flat = counts.reshape(frames, int(np.prod(shape)))
    value = np.asarray(values(flat.sum(axis=0).reshape(shape)), np.float64)
    if frames == 0:
        return np.stack([value, np.full(value.shape, np.nan), np.full(value.shape, np.nan)])
    rng, drawn = np.random.default_rng(params.seed), []
    step = max(1, DRAWN // frames)
    for first in range(0, params.replicates, step):
        rows = min(step, params.replicates - first)
        # How often each frame was drawn: the multinomial weights of its counts.
        indices = rng.integers(frames, size=(rows, frames)) + frames * np.arange(rows)[:, None]
        weights = np.bincount(indices.ravel(), minlength=rows * frames).reshape(rows, frames)
        drawn.append(values((weights @ flat).reshape(rows, *shape)))
    limits = _percentiles(np.concatenate(drawn), params.level)
    return np.stack([value, *np.where(np.isnan(value), np.nan, limits)])


def _percentiles(drawn: np.ndarray, level: float) -> np.ndarray:
    """(2, *V) ends of the interval of (R, *V) replicates; NaN where all of them are."""
    known = np.where(np.isnan(drawn).all(axis=0), 0.0, drawn)  # or NumPy would warn
    ends = np.nanpercentile(known, [50 - 50 * level, 50 + 50 * level], axis=0)
    return np.where(np.isnan(drawn).all(axis=0), np.nan, ends)


def ratio(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """part / whole; NaN where whole is 0."""
    part, whole = np.broadcast_arrays(np.asarray(part, float), np.asarray(whole, float))
    return np.divide(part, whole, out=np.full(part.shape, np.nan), where=whole != 0)


def rates(tp: np.ndarray, fp: np.ndarray, fn: np.ndarray) -> np.ndarray:
    """(..., 3) recall, precision, F1 in percent of counts (...,); NaN where there are no cases."""
    return 100 * np.stack([ratio(tp, tp + fn), ratio(tp, tp + fp),
                           ratio(2 * tp, 2 * tp + fp + fn)], axis=-1)


def cells(estimates: np.ndarray, paper: Iterable[float | None] = (),
          digits: int | Iterable[int] = 1) -> tuple[Cell, ...]:
    """Cells of estimates (3, V) from bootstrap(); the paper's figures and the decimals in the same
    order, or one number of decimals for all."""
    count = estimates.shape[1]
    paper = [*paper] or [None] * count
    digits = [digits] * count if isinstance(digits, int) else [*digits]
    return tuple(Cell(value, low, high, there, shown) for (value, low, high), there, shown in
                 zip(map(known, estimates.T), paper, digits, strict=True))


def curve(label: str, x: Iterable[float], estimates: np.ndarray) -> Line:
    """A line of a figure, with its interval, of estimates (3, X) from bootstrap()."""
    value, low, high = map(known, estimates)
    return Line(label, tuple(x), value, low, high)


def stack(rows: list, *shape: int) -> np.ndarray:
    """(F, *shape) float64 of one entry a frame; also of no frames."""
    return np.array(rows, np.float64).reshape(len(rows), *shape)


def known(values: Iterable[float]) -> list[float | None]:
    """Floats, with None for NaN."""
    return [None if np.isnan(v) else float(v) for v in values]
