"""The scale of intensities: drivers write 0..1, percent, 8, 10, 12 or 16 bits; the core takes 0..1.

Every source goes through `full_scale`, which infers the scale where nobody declares it, and
`to_unit`, which applies it. See docs/reference/recordings.md#intensity.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike

MAX_UNIT = 1.5        # a cloud in 0..1 exceeds 1 by noise and calibration, but not this
PERCENT = 100.0
BITS = (255.0, 1023.0, 4095.0, 65535.0)  # 8, 10, 12 and 16 bits
TOLERANCE = 1.001     # by which a value may exceed its scale: rounding
MAX_OUTLIERS = 1e-4   # share of the values of a cloud that may lie beyond its scale
WHOLE_SAMPLE = 10_000  # values that are checked for being whole numbers
MIN_BRIGHT = 0.05     # a cloud of MIN_POINTS whose values all lie below has another scale
MIN_POINTS = 1000
INTENSITY_FIELDS = ("intensity", "reflectivity", "i")  # the first one that a cloud has counts


def full_scale(values: np.ndarray, dtype: DTypeLike | None = None) -> float:
    """Infer which value means a full reflection, from one cloud.

    8-bit integers: the largest number of their type. Wider integers: the smallest of 255, 1023,
    4095 and 65535 that holds the values. Floats: 1 up to MAX_UNIT; percent (100) where the values
    have fractions and end there; else as for integers. No values, or only zeros, give the smallest
    scale of their type.

    Args:
        values: (N,) intensities as the driver wrote them. NaN, infinite and negative ones, and a
            share of MAX_OUTLIERS, do not count.
        dtype: type in which the driver wrote them, where `values` have been converted.
    """
    kind = np.dtype(values.dtype if dtype is None else dtype)
    if kind.kind in "iu" and kind.itemsize == 1:
        return float(np.iinfo(kind).max)
    if kind.kind not in "iu":
        if not _exceeds(values, MAX_UNIT):
            return 1.0
        some = values[::max(1, len(values) // WHOLE_SAMPLE)]
        some = some[np.isfinite(some)]
        if (some != np.round(some)).any() and not _exceeds(values, PERCENT * TOLERANCE):
            return PERCENT
    return next((full for full in BITS if not _exceeds(values, full * TOLERANCE)), BITS[-1])


def _exceeds(values: np.ndarray, limit: float) -> bool:
    """Return True where more than MAX_OUTLIERS of the values are finite and above the limit."""
    if np.fmax.reduce(values, initial=0) <= limit:
        return False
    beyond = np.count_nonzero((values > limit) & (values < np.inf))
    return bool(beyond > MAX_OUTLIERS * len(values))


def to_unit(values: np.ndarray, full: float) -> np.ndarray:
    """(N,) float32: intensities divided by the value of a full reflection, so 0..1. NaN, infinite
    and negative ones become 0. Values above `full` stay above 1, so that scale_problem sees
    them."""
    with np.errstate(over="ignore"):  # float64 beyond float32 becomes inf
        values = np.asarray(values, np.float32)
    valid = (values >= 0) & (values < np.inf)
    if not valid.all():
        values = np.where(valid, values, np.float32(0))
    return values / np.float32(full)


class StreamScale:
    """full_scale() of the clouds of one stream: the largest scale that any of them has had, so
    that a dark cloud between others is not read in another scale. `full` is 0 before the first
    cloud."""

    def __init__(self) -> None:
        self.full = 0.0

    def __call__(self, values: np.ndarray, dtype: DTypeLike | None = None) -> float:
        """Return the scale of the stream, after this cloud; arguments as of full_scale."""
        self.full = max(self.full, full_scale(values, dtype))
        return self.full


def scale_problem(intensity: np.ndarray | None, factor: float = 1.0) -> str | None:
    """Say what is wrong with the scale of intensities (N,) that should be 0..1, with the remedy;
    None where nothing is, or where there is no intensity.

    factor: by which the reader multiplies them, as `fused.intensity_scale` does.
    """
    if intensity is None or factor == 0.0:
        return None
    greatest = float(np.fmax.reduce(intensity, initial=0)) * factor
    inferred = guessed_scale(intensity, factor)
    if inferred == 1.0 and (greatest == 0.0 or greatest >= MIN_BRIGHT
                            or len(intensity) < MIN_POINTS):
        return None
    guess = f", so it is divided by {inferred:g}, a guess" if inferred != 1.0 else ""
    return (f"intensity goes up to {greatest:.3g} where 1 is a full reflection{guess}; set "
            "input.intensity_max, or in Python intensity_max of LidarFrame.of, to the value of a "
            "full reflection (1, 100 or 255 for most drivers; setup measures it)")


def guessed_scale(intensity: np.ndarray, factor: float = 1.0) -> float:
    """Return the full_scale() of intensities (N,) that should be 0..1 and are multiplied by factor;
    1 where they are in 0..1, with or without the factor."""
    if not _exceeds(intensity, MAX_UNIT) or not _exceeds(intensity, MAX_UNIT / max(factor, 1e-9)):
        return 1.0
    return full_scale(intensity)
