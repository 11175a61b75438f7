"""Conversion of intensities to 0..1: drivers write 0..1, percent, or 8, 10, 12 or 16 bits.

`infer_full_scale` infers a scale that is not declared, and `to_unit` applies it. See
docs/reference/recordings.md#intensity. Networks read the result of `normalize_intensity`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike

MAX_UNIT = 1.5  # largest intensity accepted on the scale 0..1, because noise and calibration can exceed 1 slightly
PERCENT = 100.0
BITS = (255.0, 1023.0, 4095.0, 65535.0)  # full scale with 8, 10, 12 and 16 bits
TOLERANCE = 1.001  # factor by which a rounded value may exceed its scale
MAX_OUTLIERS = 1e-4  # maximum fraction of the values of a cloud that may exceed its scale
SAMPLE_SIZE = 10_000  # number of values of a cloud that are inspected where all would take too long
MIN_BRIGHT = 0.05  # expected minimum of the highest intensity in a cloud
MIN_POINTS = 1000  # number of points from which MIN_BRIGHT applies
MIN_POSITIVE = 0.1  # minimum fraction of points with a positive intensity for it to be usable
# Distribution of positive intensities in the input of networks, like that of an HDL-64E in towns:
# quantile levels, and the intensity at each level.
REFERENCE_LEVELS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 1.0)
REFERENCE_VALUES = (
    0.01,
    0.05,
    0.09,
    0.135,
    0.185,
    0.225,
    0.26,
    0.285,
    0.31,
    0.335,
    0.37,
    0.42,
    0.48,
    0.55,
    0.62,
    0.71,
    0.99,
)
INTENSITY_FIELDS = ("intensity", "reflectivity", "i")  # the first one present is used


def infer_full_scale(values: np.ndarray, dtype: DTypeLike | None = None) -> float:
    """Infer the intensity of a full reflection from one cloud.

    The scale depends on the type of the values:

    - 8-bit integers: the largest number of the type.
    - Wider integers: the smallest of BITS that is not exceeded.
    - Floats: 1 if MAX_UNIT is not exceeded, 100 (percent) if 100 is not exceeded and there are
      fractions, otherwise as for integers.

    Without positive values, the result is the smallest scale of the type.

    Args:
        values: (N,) intensities as the driver wrote them. NaN, infinite and negative values are
            ignored, and a fraction of MAX_OUTLIERS may exceed the scale.
        dtype: type in the driver's message, if `values` were converted from it.
    """
    value_type = np.dtype(values.dtype if dtype is None else dtype)
    if value_type.kind in "iu" and value_type.itemsize == 1:
        return float(np.iinfo(value_type).max)
    if value_type.kind not in "iu":
        if not _exceeds(values, MAX_UNIT):
            return 1.0
        sample = values[:: max(1, len(values) // SAMPLE_SIZE)]
        sample = sample[np.isfinite(sample)]
        if (sample != np.round(sample)).any() and not _exceeds(values, PERCENT * TOLERANCE):
            return PERCENT
    return next((scale for scale in BITS if not _exceeds(values, scale * TOLERANCE)), BITS[-1])


def _exceeds(values: np.ndarray, limit: float) -> bool:
    """Return True if more than a fraction MAX_OUTLIERS of the values are finite and above the limit."""
    if np.fmax.reduce(values, initial=0) <= limit:
        return False
    count = np.count_nonzero((values > limit) & (values < np.inf))
    return bool(count > MAX_OUTLIERS * len(values))


def to_unit(values: np.ndarray, full_scale: float) -> np.ndarray:
    """Convert intensities (N,) to float32, 0..1, by dividing by the value of a full reflection.

    NaN, infinite and negative values become 0. Values above `full_scale` exceed 1, so that
    find_scale_problem can report them.
    """
    with np.errstate(over="ignore"):  # float64 beyond float32 becomes inf
        values = np.asarray(values, np.float32)
    is_valid = (values >= 0) & (values < np.inf)
    if not is_valid.all():
        values = np.where(is_valid, values, np.float32(0))
    return values / np.float32(full_scale)


def normalize_intensity(intensity: np.ndarray | None, indices: np.ndarray | None = None) -> np.ndarray | None:
    """Map the intensities of a cloud to the distribution that networks are trained with.

    The result depends only on the order of the intensities, so gain, gamma and scale of the sensor
    have no effect. Zeros, which sensors report for the weakest returns, stay 0.

    Args:
        intensity: (N,) intensities, NaN for unknown ones, or None.
        indices: (M,) points to return; None: all.

    Returns:
        (N,) or (M,) float32; None if the intensities are not usable, see has_usable_intensity.
    """
    if intensity is None or not has_usable_intensity(intensity):
        return None
    knots = _compute_quantiles(intensity[intensity > 0], np.array(REFERENCE_LEVELS))
    # np.interp needs ascending knots, so equal knots are merged and get the mean of their values.
    distinct_knots, inverse = np.unique(knots, return_inverse=True)
    mean_values = np.bincount(inverse, REFERENCE_VALUES) / np.bincount(inverse)
    if indices is not None:
        intensity = intensity.take(indices)
    result = np.interp(intensity, distinct_knots, mean_values).astype(np.float32)
    result[intensity <= 0] = 0
    return result


def _compute_quantiles(values: np.ndarray, fractions: np.ndarray) -> np.ndarray:
    """Compute np.quantile(values, fractions), (K,) float64, ten times as fast because it sorts once."""
    values = np.sort(values)
    positions = fractions * (len(values) - 1)
    low = positions.astype(np.int64)
    high = np.minimum(low + 1, len(values) - 1)
    low_values, high_values = values[low].astype(np.float64), values[high].astype(np.float64)
    return low_values + (high_values - low_values) * (positions - low)


def has_usable_intensity(intensity: np.ndarray | None) -> bool:
    """Return True if the intensities (N,) of a cloud are usable as input of a network.

    More than a fraction MIN_POSITIVE must be positive, and the positive ones must not be nearly all
    equal.
    """
    if intensity is None:
        return False
    sample = intensity[:: max(1, len(intensity) // SAMPLE_SIZE)]
    positive_values = sample[sample > 0]
    if len(positive_values) <= MIN_POSITIVE * len(sample):
        return False
    low, high = _compute_quantiles(positive_values, np.array([0.1, 0.9]))
    return bool(low < high)


class StreamScale:
    """Intensity scale of a stream of clouds: the largest scale inferred from any cloud so far.

    A dark cloud therefore does not change the scale. `full_scale` is 0 before the first cloud.
    """

    def __init__(self) -> None:
        self.full_scale = 0.0

    def __call__(self, values: np.ndarray, dtype: DTypeLike | None = None) -> float:
        """Update the scale with a cloud and return it; see infer_full_scale."""
        self.full_scale = max(self.full_scale, infer_full_scale(values, dtype))
        return self.full_scale


def find_scale_problem(intensity: np.ndarray | None) -> str | None:
    """Return a message about intensities (N,) that are not on the scale 0..1, with the remedy, or None."""
    if intensity is None:
        return None
    max_value = float(np.fmax.reduce(intensity, initial=0))
    guessed_scale = guess_scale(intensity)
    if guessed_scale == 1.0 and (max_value == 0.0 or max_value >= MIN_BRIGHT or len(intensity) < MIN_POINTS):
        return None
    guess_text = f", so a full scale of {guessed_scale:g} is assumed" if guessed_scale != 1.0 else ""
    return (
        f"the highest intensity is {max_value:.3g}, but a full reflection should be 1{guess_text}; set "
        "input.intensity_max, or in Python intensity_max of PointCloud.of, to the value of a full reflection (1, 100 "
        "or 255 for most drivers; setup measures it)"
    )


def guess_scale(intensity: np.ndarray) -> float:
    """Return 1 if intensities (N,) are 0..1 as they should be, otherwise infer_full_scale()."""
    return infer_full_scale(intensity) if _exceeds(intensity, MAX_UNIT) else 1.0
