"""How often the sensor turns, and what is missing between its clouds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lidar_perception.sensor_setup.scans import Scan

GAP = 1.5           # times the usual distance of two stamps, from which on clouds are missing
RATES = (0.5, 100.0)  # turns a second that sensors make
FEWEST = 4          # stamps, of which a rate is told


class Timing(NamedTuple):
    """rate: turns a second, NaN where it cannot be told; by: stamps, times of the points, or
    nothing; jitter: s, robust standard deviation of the distances of stamps; gaps: how often
    clouds are missing, and missing: how many; backwards: stamps that are not after the one
    before; turns: "counter-clockwise", "clockwise" or "" by the times, or else the order, of the
    points."""

    rate: float
    by: str
    jitter: float
    gaps: int
    missing: int
    backwards: int
    turns: str


def timing_of(scans: Sequence[Scan], stamps_ns: np.ndarray | None) -> Timing:
    """From the stamps of all clouds (M,), if there are any, and the columns of the scans."""
    spans = [float(np.nanmax(s.seconds) - np.nanmin(s.seconds)) for s in scans
             if s.seconds is not None]
    turns = _turning(scans)
    if stamps_ns is not None and len(stamps_ns) >= FEWEST:
        apart = np.diff(stamps_ns) * 1e-9
        ahead = apart[apart > 0]
        usual = float(np.median(ahead)) if len(ahead) else 0.0
        if usual > 0 and RATES[0] <= 1 / usual <= RATES[1]:
            long = ahead > GAP * usual
            long &= ahead < 1000 * usual  # longer ones are between drives
            missing = int((np.round(ahead[long] / usual) - 1).sum())
            jitter = 1.4826 * float(np.median(np.abs(ahead - usual)))
            return Timing(1 / usual, "stamps", jitter, int(long.sum()), missing,
                          int((apart <= 0).sum()), turns)
    if spans and RATES[0] <= 1 / max(np.median(spans), 1e-9) <= RATES[1]:
        return Timing(1 / float(np.median(spans)), "times of the points", np.nan, 0, 0, 0, turns)
    return Timing(np.nan, "nothing", np.nan, 0, 0, 0, turns)


def _turning(scans: Sequence[Scan]) -> str:
    """Which way, by how the azimuth changes with time, or from point to point."""
    ways = []
    for scan in scans:
        azimuth = scan.azimuth
        if scan.seconds is not None and np.ptp(scan.seconds) > 0:
            azimuth = azimuth[np.argsort(scan.seconds, kind="stable")]
        step = (np.diff(azimuth) + 180) % 360 - 180
        small = step[(np.abs(step) > 1e-4) & (np.abs(step) < 5.0)]
        if len(small):
            ways.append(float(np.sign(small).mean()))
    way = float(np.median(ways)) if ways else 0.0
    return "" if abs(way) < 0.2 else "counter-clockwise" if way > 0 else "clockwise"
