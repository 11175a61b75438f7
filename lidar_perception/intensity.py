"""Scale of intensities: drivers write 0..1, percent, 8, 10, 12 or 16 bits; the core uses 0..1.

`infer_full_scale` infers a scale that is not declared, and `to_unit` applies it. See
docs/reference/recordings.md#intensity. Networks read the result of `normalize_intensity`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike

MAX_UNIT = 1.5  # noise and calibration make intensities of 0..1 exceed 1, but not this value
PERCENT = 100.0
BITS = (255.0, 1023.0, 4095.0, 65535.0)  # 8, 10, 12 and 16 bits
TOLERANCE = 1.001  # factor by which rounding lets a value exceed its scale
MAX_OUTLIERS = 1e-4  # maximum fraction of the values of a cloud that exceed its scale
WHOLE_SAMPLE = 10_000  # number of values that are checked for being whole numbers
MIN_BRIGHT = 0.05  # expected minimum of the highest intensity in a cloud
MIN_POINTS = 1000  # number of points from which MIN_BRIGHT applies
MIN_KNOWN = 0.1  # fraction of the points that must have an intensity for it to be usable
# Distribution of positive intensities in the input of networks, like that of an HDL-64E in towns:
# quantile levels, and the intensity at each level.
REFERENCE_SHARES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 1.0)
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

    Without values above 0, it is the smallest scale of the type.

    Args:
        values: (N,) intensities as the driver wrote them. NaN, infinite and negative values are
            ignored, and a fraction of MAX_OUTLIERS may exceed the scale.
        dtype: original type in the driver's message, if `values` were converted.
    """
    value_type = np.dtype(values.dtype if dtype is None else dtype)
    if value_type.kind in "iu" and value_type.itemsize == 1:
        return float(np.iinfo(value_type).max)
    if value_type.kind not in "iu":
        if not _exceeds(values, MAX_UNIT):
            return 1.0
        sample = values[:: max(1, len(values) // WHOLE_SAMPLE)]
        sample = sample[np.isfinite(sample)]
        if (sample != np.round(sample)).any() and not _exceeds(values, PERCENT * TOLERANCE):
            return PERCENT
    return next((full for full in BITS if not _exceeds(values, full * TOLERANCE)), BITS[-1])


def _exceeds(values: np.ndarray, limit: float) -> bool:
    """Return True if more than a fraction MAX_OUTLIERS of the values is finite and above the limit."""
    if np.fmax.reduce(values, initial=0) <= limit:
        return False
    count = np.count_nonzero((values > limit) & (values < np.inf))
    return bool(count > MAX_OUTLIERS * len(values))


def to_unit(values: np.ndarray, full: float) -> np.ndarray:
    """Divide intensities by the value of a full reflection; return (N,) float32, 0..1.

    NaN, infinite and negative values become 0. Values above `full` exceed 1, so that
    find_scale_problem can report them.
    """
    with np.errstate(over="ignore"):  # float64 beyond float32 becomes inf
        values = np.asarray(values, np.float32)
    valid = (values >= 0) & (values < np.inf)
    if not valid.all():
        values = np.where(valid, values, np.float32(0))
    return values / np.float32(full)


def normalize_intensity(intensity: np.ndarray | None, indices: np.ndarray | None = None) -> np.ndarray | None:
    """Map the intensities of a cloud to the distribution that networks are trained with.

    The result depends only on the order of the intensities, so gain, gamma and scale of the sensor
    have no effect. Zeros, which sensors report for the weakest returns, stay 0.

    Args:
        intensity: (N,) intensities, NaN for unknown ones, or None.
        indices: (M,) points to return; None: all.

    Returns:
        (N,) or (M,) float32; None if the intensity is not usable, see has_usable_intensity.
    """
    if intensity is None or not has_usable_intensity(intensity):
        return None
    knots = _compute_quantiles(intensity[intensity > 0], np.array(REFERENCE_SHARES))
    # np.interp needs ascending knots, so equal ones are replaced by their middle.
    distinct_knots, inverse = np.unique(knots, return_inverse=True)
    mean_values = np.bincount(inverse, REFERENCE_VALUES) / np.bincount(inverse)
    if indices is not None:
        intensity = intensity.take(indices)
    positive = intensity > 0
    normalized = np.where(np.isnan(intensity), intensity, np.float32(0)).astype(np.float32)
    normalized[positive] = np.interp(intensity[positive], distinct_knots, mean_values)
    return normalized


def _compute_quantiles(values: np.ndarray, fractions: np.ndarray) -> np.ndarray:
    """Return np.quantile(values, fractions), (K,) float64; sorts once, ten times as fast as NumPy."""
    values = np.sort(values)
    positions = fractions * (len(values) - 1)
    low = positions.astype(np.int64)
    high = np.minimum(low + 1, len(values) - 1)
    below, above = values[low].astype(np.float64), values[high].astype(np.float64)
    return below + (above - below) * (positions - low)


def has_usable_intensity(intensity: np.ndarray | None) -> bool:
    """Return True if the intensities (N,) of a cloud are usable as input of a network.

    More than a fraction MIN_KNOWN must be positive, and the positive ones must not be nearly all
    equal.
    """
    if intensity is None:
        return False
    sample = intensity[:: max(1, len(intensity) // WHOLE_SAMPLE)]
    positive = sample[sample > 0]
    if len(positive) <= MIN_KNOWN * len(sample):
        return False
    low, high = _compute_quantiles(positive, np.array([0.1, 0.9]))
    return bool(low < high)


class StreamScale:
    """Scale of a stream of clouds: the largest scale of any cloud so far.

    A dark cloud is therefore not read with another scale. `full` is 0 before the first cloud.
    """

    def __init__(self) -> None:
        self.full = 0.0

    def __call__(self, values: np.ndarray, dtype: DTypeLike | None = None) -> float:
        """Return the scale of the stream including this cloud; see infer_full_scale."""
        self.full = max(self.full, infer_full_scale(values, dtype))
        return self.full


def find_scale_problem(intensity: np.ndarray | None) -> str | None:
    """Return a message with the remedy if intensities (N,) that should be 0..1 have a wrong scale."""
    if intensity is None:
        return None
    max_value = float(np.fmax.reduce(intensity, initial=0))
    inferred = guess_scale(intensity)
    if inferred == 1.0 and (max_value == 0.0 or max_value >= MIN_BRIGHT or len(intensity) < MIN_POINTS):
        return None
    guess_text = f", so it is divided by {inferred:g}, a guess" if inferred != 1.0 else ""
    return (
        f"intensity goes up to {max_value:.3g} where 1 is a full reflection{guess_text}; set "
        "input.intensity_max, or in Python intensity_max of PointCloud.of, to the value of a "
        "full reflection (1, 100 or 255 for most drivers; setup measures it)"
    )


def guess_scale(intensity: np.ndarray) -> float:
    """Return infer_full_scale() of intensities (N,) that should be 0..1."""
    return infer_full_scale(intensity) if _exceeds(intensity, MAX_UNIT) else 1.0
