"""Rate of the sensor, and clouds missing between the recorded ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lidar_perception.sensor_setup.measurement.scans import Scan

MIN_GAP = 1.5  # stamp gap, as a multiple of the usual one, from which clouds count as missing
MAX_GAP = 1000  # multiple of the usual gap; longer gaps separate drives
RATES = (0.5, 100.0)  # plausible rotation rates in revolutions per second
MIN_STAMPS = 4  # minimum number of stamps to compute a rate


class Timing(NamedTuple):
    """Timing of the clouds.

    Attributes:
        rate: Turns per second, NaN if unknown.
        source: Source of the rate: "stamps", "times of the points" or "nothing".
        missing: Number of clouds missing between the recorded ones.
        backwards: Number of stamps that are not after the previous one.
    """

    rate: float
    source: str
    missing: int = 0
    backwards: int = 0


def measure_timing(scans: Sequence[Scan], stamps_ns: np.ndarray | None) -> Timing:
    """Measure rate and losses.

    Args:
        scans: Scans, whose points may have times.
        stamps_ns: (M,) stamps of all clouds in ns; None without any.
    """
    spans = [float(np.nanmax(s.seconds) - np.nanmin(s.seconds)) for s in scans if s.seconds is not None]
    if stamps_ns is not None and len(stamps_ns) >= MIN_STAMPS:
        steps = np.diff(stamps_ns) * 1e-9
        forward = steps[steps > 0]
        usual = float(np.median(forward)) if len(forward) else 0.0
        if usual > 0 and RATES[0] <= 1 / usual <= RATES[1]:
            gaps = forward[(forward > MIN_GAP * usual) & (forward < MAX_GAP * usual)]
            missing = int((np.round(gaps / usual) - 1).sum())
            return Timing(1 / usual, "stamps", missing, int((steps <= 0).sum()))
    if spans and RATES[0] <= 1 / max(np.median(spans), 1e-9) <= RATES[1]:
        return Timing(1 / float(np.median(spans)), "times of the points")
    return Timing(np.nan, "nothing")
