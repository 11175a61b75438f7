"""Rate of the sensor, and clouds missing between the recorded ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lidar_perception.sensor_setup.measurement.scans import Scan

MIN_GAP = 1.5         # times the usual distance of two stamps, from which on clouds are missing
MAX_GAP = 1000        # times; longer gaps separate drives
RATES = (0.5, 100.0)  # turns per second of real sensors
MIN_STAMPS = 4        # for a rate


class Timing(NamedTuple):
    """Timing of the clouds.

    Attributes:
        rate: Turns per second, NaN if unknown.
        source: Source of the rate: "stamps", "times of the points" or "nothing".
        jitter: Robust standard deviation of the distances of stamps, s.
        gaps: Number of gaps in which clouds are missing.
        missing: Number of missing clouds.
        backwards: Number of stamps that are not after the previous one.
        direction: "counter-clockwise", "clockwise", or "" if unknown.
    """

    rate: float
    source: str
    jitter: float
    gaps: int
    missing: int
    backwards: int
    direction: str


def measure_timing(scans: Sequence[Scan], stamps_ns: np.ndarray | None) -> Timing:
    """Measure rate and losses.

    Args:
        scans: Scans, whose points may have times.
        stamps_ns: (M,) stamps of all clouds in ns; None without any.
    """
    spans = [float(np.nanmax(s.seconds) - np.nanmin(s.seconds)) for s in scans
             if s.seconds is not None]
    direction = _find_direction(scans)
    if stamps_ns is not None and len(stamps_ns) >= MIN_STAMPS:
        steps = np.diff(stamps_ns) * 1e-9
        forward = steps[steps > 0]
        usual = float(np.median(forward)) if len(forward) else 0.0
        if usual > 0 and RATES[0] <= 1 / usual <= RATES[1]:
            is_gap = forward > MIN_GAP * usual
            is_gap &= forward < MAX_GAP * usual
            missing = int((np.round(forward[is_gap] / usual) - 1).sum())
            jitter = 1.4826 * float(np.median(np.abs(forward - usual)))
            return Timing(1 / usual, "stamps", jitter, int(is_gap.sum()), missing,
                          int((steps <= 0).sum()), direction)
    if spans and RATES[0] <= 1 / max(np.median(spans), 1e-9) <= RATES[1]:
        return Timing(1 / float(np.median(spans)), "times of the points", np.nan, 0, 0, 0,
                      direction)
    return Timing(np.nan, "nothing", np.nan, 0, 0, 0, direction)


def _find_direction(scans: Sequence[Scan]) -> str:
    """Find the direction of rotation from azimuths over time, or in the order of the points."""
    signs = []
    for scan in scans:
        azimuth = scan.azimuth
        if scan.seconds is not None and np.ptp(scan.seconds) > 0:
            azimuth = azimuth[np.argsort(scan.seconds, kind="stable")]
        step = (np.diff(azimuth) + 180) % 360 - 180
        small = step[(np.abs(step) > 1e-4) & (np.abs(step) < 5.0)]
        if len(small):
            signs.append(float(np.sign(small).mean()))
    sign = float(np.median(signs)) if signs else 0.0
    return "" if abs(sign) < 0.2 else "counter-clockwise" if sign > 0 else "clockwise"
