"""Rate of the sensor, and number of missing clouds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lidar_perception.sensor_setup.measurement.scans import Scan

# Range of gaps between stamps, in median periods, in which clouds are missing. Longer gaps separate drives.
MIN_GAP, MAX_GAP = 1.5, 1000
MIN_RATE, MAX_RATE = 0.5, 100.0  # rates of real sensors, in revolutions per second
MIN_STAMPS = 4  # minimum number of stamps to compute a rate


class Timing(NamedTuple):
    """Timing of the clouds.

    Attributes:
        rate: Revolutions per second, NaN if unknown.
        source: Source of the rate: "stamps", "times of the points" or "nothing".
        missing_count: Number of missing clouds between the recorded ones.
        backward_count: Number of stamps that are not later than the previous one.
    """

    rate: float
    source: str
    missing_count: int = 0
    backward_count: int = 0


def measure_timing(scans: Sequence[Scan], stamps_ns: np.ndarray | None) -> Timing:
    """Measure the rate of the sensor, and count missing clouds.

    Args:
        scans: The scans. Without stamps, the rate comes from the times of their points.
        stamps_ns: (M,) stamps of all clouds in ns; None if they have none.
    """
    spans = [float(np.nanmax(s.seconds) - np.nanmin(s.seconds)) for s in scans if s.seconds is not None]
    if stamps_ns is not None and len(stamps_ns) >= MIN_STAMPS:
        steps = np.diff(stamps_ns) * 1e-9
        forward_steps = steps[steps > 0]
        period = float(np.median(forward_steps)) if len(forward_steps) else 0.0
        if period > 0 and MIN_RATE <= 1 / period <= MAX_RATE:
            gaps = forward_steps[(forward_steps > MIN_GAP * period) & (forward_steps < MAX_GAP * period)]
            missing_count = int((np.round(gaps / period) - 1).sum())
            return Timing(1 / period, "stamps", missing_count, int((steps <= 0).sum()))
    if spans and MIN_RATE <= 1 / max(np.median(spans), 1e-9) <= MAX_RATE:
        return Timing(1 / float(np.median(spans)), "times of the points")
    return Timing(np.nan, "nothing")
