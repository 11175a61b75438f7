"""The beams of the sensor: their elevations, the beam of each point, and the noise along them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks, peak_prominences

from lidar_perception.sensor_setup.measurement.scans import Scan

MIN_BEAM_POINTS = 30  # minimum points of a beam in a scan for a fit
MAX_BEAMS = 300
BIN = 0.02  # bin width of the elevation histogram, in degrees
MIN_RANGE_M = 2.0  # at shorter range, small offsets of a beam change its elevation much
# Maximum scatter of a beam's points about it in degrees (median over the beams), if beams
# are identified by the ring column, the order of the points, or the elevation.
MAX_SPREAD = {"ring": 3.0, "order": 0.12, "elevation": 0.01}
MIN_PEAK_SHARE = 0.75  # minimum fraction of points in the inner half of the spacing between peaks
MIN_USUAL_SHARE = 0.2  # minimum fraction of scans that must agree on a number of beams
SECTORS = 72  # sectors of a revolution
MAX_LIFT_ERROR_M = 0.01
MIN_LIFT_M = 0.03  # beams whose origins are closer together share one origin
MAX_LIFT_M = 0.5  # larger than any sensor is high
ANGLE_RESOLUTION = 1e-3  # rounding of angles, in degrees
MAX_GAP_STEPS = 3.5  # maximum gap, in azimuth steps, whose lost returns are counted
PIECE_POINTS = 9  # number of neighbouring returns to fit a parabola to


class Beams(NamedTuple):
    """B beams from the highest to the lowest.

    Attributes:
        elevations: (B,) degrees.
        lifts: (B,) m along the z axis to the start of the beam; 0 if all start at one point.
        spread: (B,) median distance of a beam's points from it, degrees.
        error: (B,) error of the elevation in degrees, from its scatter between scans, or within
            one.
        labels: Beam of each point of each scan, (N,) int64, -1 for none.
        method: How beams were identified: "ring", "order" or "elevation".
    """

    elevations: np.ndarray
    lifts: np.ndarray
    spread: np.ndarray
    error: np.ndarray
    labels: list[np.ndarray]
    method: str


def find_beams(scans: Sequence[Scan]) -> Beams | None:
    """Find the beams of a sensor that turns about its z axis.

    Returns:
        The beams; None if none are found, for example with a non-repeating scan pattern, or if the
        frame is rotated relative to the sensor.
    """
    for method, label in (("ring", _label_by_ring), ("order", _label_by_order), ("elevation", _label_by_elevation)):
        labels = label(scans)
        if labels is None:
            continue
        beams = _fit_beams(scans, labels, method)
        if beams is None or len(beams.elevations) < 2:
            continue
        # A pattern that does not repeat has no beams, even if there is a ring column.
        limit = min(MAX_SPREAD[method], float(np.median(-np.diff(beams.elevations))) / 2)
        if np.median(beams.spread) <= limit and np.abs(beams.lifts).max() <= MAX_LIFT_M:
            return beams
    return None


def _label_by_ring(scans: Sequence[Scan]) -> list[np.ndarray] | None:
    rings = [scan.ring for scan in scans if scan.ring is not None]
    if len(rings) < len(scans) or not all(0 <= r.min() and r.max() < MAX_BEAMS for r in rings):
        return None
    return rings if max(len(np.unique(r)) for r in rings) > 1 else None


def _label_by_order(scans: Sequence[Scan]) -> list[np.ndarray] | None:
    """Label points of clouds like KITTI's, in which each beam's full turn follows the previous."""
    labels = []
    for scan in scans:
        best: tuple[float, np.ndarray] | None = None
        for seam in (0.0, 180.0, float(scan.azimuth[0]) - 0.5):
            azimuth = (scan.azimuth - seam) % 360.0
            step = np.diff(azimuth)
            forward = step if np.median(step) >= 0 else -step
            starts = forward < -30.0  # a revolution starts
            count = int(starts.sum()) + 1
            if not 4 <= count <= MAX_BEAMS or len(azimuth) / count < MIN_BEAM_POINTS or ((forward < 0).mean() > 0.1):
                continue
            label = np.concatenate([[0], np.cumsum(starts)])
            parts = np.split(scan.elevation, np.flatnonzero(starts) + 1)
            spread = float(np.median([_mad(part) for part in parts[::4] if len(part) >= MIN_BEAM_POINTS] or [np.inf]))
            if best is None or spread < best[0]:
                best = spread, label
        if best is None:
            return None
        labels.append(best[1])
    # A beam without points shifts the numbers of the following ones. Therefore only scans with one number
    # of beams are used: the greatest common one.
    shares = np.bincount([int(label[-1]) for label in labels]) / len(labels)
    usual = int(np.flatnonzero(shares >= min(MIN_USUAL_SHARE, shares.max())).max())
    return [label if label[-1] == usual else np.full(len(label), -1) for label in labels]


def _label_by_elevation(scans: Sequence[Scan]) -> list[np.ndarray] | None:
    """Label points by the peaks of the histogram of elevations."""
    far = [scan.elevation[scan.range > MIN_RANGE_M] for scan in scans]
    whole = [scan.elevation for scan in scans]
    points = np.concatenate(far if sum(map(len, far)) > 0.3 * sum(map(len, whole)) else whole)
    edges = np.arange(-90.0, 90.0 + BIN, BIN)
    counts = gaussian_filter1d(np.histogram(points, edges)[0].astype(float), 1.0)
    # Relative to several high peaks, since two beams may have the same elevation.
    tall = np.sort(counts)[-20:].mean()
    peaks, _ = find_peaks(counts, height=0.01 * tall, prominence=0.005 * tall)
    real = [p for p, q in zip(peaks, peak_prominences(counts, peaks)[0]) if q > 0.5 * counts[p]]
    if not 2 <= len(real) <= MAX_BEAMS:
        return None
    middle = (edges[:-1] + edges[1:])[real] / 2
    borders = np.concatenate([[-90.0], (middle[1:] + middle[:-1]) / 2, [90.0]])
    room = np.minimum(np.diff(borders)[1:-1], 2.0) if len(middle) > 2 else np.diff(middle)
    which = np.clip(np.searchsorted(borders, points) - 1, 0, len(middle) - 1)
    inner: np.ndarray = np.abs(points - middle[which]) < np.median(room) / 4
    if inner.mean() < MIN_PEAK_SHARE:
        return None
    highest = len(middle) - 1
    reach = np.median(room) / 2
    labels = []
    for elevation in whole:
        k = np.clip(np.searchsorted(borders, elevation) - 1, 0, highest)
        labels.append(np.where(np.abs(elevation - middle[k]) < max(reach, 0.1), highest - k, -1))
    return labels


class _Points(NamedTuple):
    """Points of one beam in all scans: distance from the axis and z in m, and scan and sector."""

    distance: np.ndarray
    z: np.ndarray
    sector: np.ndarray

    def elevation(self, lift: float) -> np.ndarray:
        """Return elevations in degrees as seen from `lift` metres up the axis."""
        return np.degrees(np.arctan2(self.z - lift, self.distance))


def _fit_beams(scans: Sequence[Scan], labels: list[np.ndarray], method: str) -> Beams | None:
    names = np.unique(np.concatenate([np.unique(label) for label in labels]))
    names = names[names >= 0]
    rows: list[list[_Points]] = [[] for _ in names]
    for number, (scan, label) in enumerate(zip(scans, labels)):
        order = np.argsort(label, kind="stable")
        first, last = (np.searchsorted(label[order], names, side) for side in ("left", "right"))
        for k, (i, j) in enumerate(zip(first, last)):
            if j - i >= MIN_BEAM_POINTS:
                own = order[i:j]
                far = scan.ground_range[own] > MIN_RANGE_M
                own = own[far] if far.sum() >= MIN_BEAM_POINTS else own
                rows[k].append(
                    _Points(
                        scan.ground_range[own],
                        scan.xyz[own, 2],
                        number * SECTORS + (scan.azimuth[own] * (SECTORS / 360)).astype(int) % SECTORS,
                    )
                )
    known = [k for k, row in enumerate(rows) if row]
    if len(known) < 2:
        return None
    beams = [_Points(*map(np.concatenate, zip(*rows[k]))) for k in known]
    lifts, sure = _fit_lifts(beams)
    elevations, spread, error = (np.empty(len(known)) for _ in range(3))
    for n, (beam, lift) in enumerate(zip(beams, lifts)):
        up = beam.elevation(lift)
        elevations[n], spread[n] = np.median(up), _mad(up)
        # With few scans, the parts of one scan differ more than the scans.
        part = beam.sector // SECTORS if len(scans) >= 5 else beam.sector // (SECTORS // 4)
        middles = np.array([np.median(up[part == i]) for i in np.unique(part)])
        error[n] = 1.2533 * 1.4826 * _mad(middles) / np.sqrt(len(middles))
        if lifts.any() and not sure[n]:
            error[n] += np.degrees(MAX_LIFT_ERROR_M / np.median(beam.distance))
    down = np.argsort(-elevations, kind="stable")
    # Beams with indistinguishable elevations count as one.
    rank = np.empty(len(known), np.int64)
    rank[down] = np.cumsum(np.concatenate([[0], np.diff(-elevations[down]) > ANGLE_RESOLUTION]))
    keep = down[np.unique(rank[down], return_index=True)[1]]
    table = np.full(int(names.max()) + 2, -1)
    table[names[known]] = rank
    return Beams(elevations[keep], lifts[keep], spread[keep], error[keep], [table[label] for label in labels], method)


def _fit_lifts(beams: list[_Points]) -> tuple[np.ndarray, np.ndarray]:
    """Fit where each beam starts on the axis: the line z = lift + tan(elevation) * distance.

    Returns:
        (B,) lifts in metres, and (B,) bool of the beams whose points have enough different
        distances to show it. The other beams get the lift of their neighbours. All lifts are 0
        unless the sure ones differ from 0.
    """
    lift, sure = np.zeros(len(beams)), np.zeros(len(beams), bool)
    for n, beam in enumerate(beams):
        every = max(1, len(beam.z) // 20_000)
        distance, z = beam.distance[::every], beam.z[::every]
        weight = 1.0 / np.maximum(distance, 0.5)  # turns the residuals into angles
        kept, off = np.ones(len(z), bool), np.zeros(len(z))
        for _ in range(4):
            if kept.sum() < MIN_BEAM_POINTS:
                break
            a = np.column_stack([np.ones(kept.sum()), distance[kept]]) * weight[kept, None]
            (lift[n], slope), *_ = np.linalg.lstsq(a, z[kept] * weight[kept], rcond=None)
            off = np.abs(z - lift[n] - slope * distance) * weight
            kept = off <= max(3 * 1.4826 * float(np.median(off)), 1e-5)
        reach = float(np.subtract(*np.percentile(weight, [90, 10])))
        scatter = 1.4826 * float(np.median(off))
        # Returns of one sector are similar, so they count as one sample.
        sure[n] = reach > 0.04 and scatter / reach / np.sqrt(len(np.unique(beam.sector))) < MAX_LIFT_ERROR_M
    if not sure.any() or np.median(np.abs(lift[sure])) < MIN_LIFT_M:
        return np.zeros(len(beams)), sure
    known = np.flatnonzero(sure)
    for n in np.flatnonzero(~sure).tolist():
        lift[n] = np.median(lift[known[np.argsort(np.abs(known - n))[:5]]])
    return lift, sure


def _mad(values: np.ndarray) -> float:
    return float(np.median(np.abs(values - np.median(values)))) if len(values) else np.inf


def measure_azimuth_step(scans: Sequence[Scan], beams: Beams) -> tuple[float, float]:
    """Return the azimuth step in degrees, and the share of second returns.

    The step is the distance of neighbouring firings of a beam, the median over beams and scans; NaN
    if no beam has enough points. Second returns have the azimuth of their neighbour.
    """
    steps, doubles = [], []
    for scan, label in zip(scans, beams.labels):
        order = np.lexsort((scan.azimuth, label))
        far = scan.ground_range[order] > MIN_RANGE_M  # near returns may be off the beam's axis
        order = order[far] if far.mean() > 0.3 else order
        for azimuth in np.split(scan.azimuth[order], np.flatnonzero(np.diff(label[order])) + 1):
            gaps = np.diff(azimuth)
            if len(azimuth) < MIN_BEAM_POINTS:
                continue
            doubles.append(float((gaps < ANGLE_RESOLUTION).mean()))
            gaps = gaps[gaps >= ANGLE_RESOLUTION]
            if len(gaps) < MIN_BEAM_POINTS // 2:
                continue
            # Encoders round azimuths, so gaps differ and their mean is used. A gap of lost returns
            # has several steps.
            step = float(np.median(gaps))
            for _ in range(3):
                used = gaps[(gaps > 0.4 * step) & (gaps < MAX_GAP_STEPS * step)]
                step = float(used.sum() / np.maximum(1, np.round(used / step)).sum())
            steps.append(step)
    if not steps:
        return np.nan, 0.0
    return float(np.median(steps)), float(np.median(doubles))


def measure_range_noise(scans: Sequence[Scan], beams: Beams, step: float) -> float:
    """Return the standard deviation of ranges about smooth surfaces in m; NaN if unknown.

    A parabola is fitted to pieces of PIECE_POINTS neighbouring returns of a beam. Pieces on rough
    surfaces scatter more, so the peak of the distribution counts.

    Args:
        step: Azimuth step in degrees.
    """
    n = PIECE_POINTS
    x = np.linspace(-1, 1, n)
    basis, _ = np.linalg.qr(np.column_stack([np.ones(n), x, x * x]))
    found = []
    for scan, label in zip(scans, beams.labels):
        order = np.lexsort((scan.azimuth, label))
        gaps = np.diff(scan.azimuth[order])
        follows = (np.diff(label[order]) == 0) & (label[order][1:] >= 0) & (gaps < 1.6 * step) & (gaps > 0.2 * step)
        runs = np.lib.stride_tricks.sliding_window_view(follows, n - 1)[::n].all(axis=1)
        pieces = np.lib.stride_tricks.sliding_window_view(scan.range[order], n)[::n][runs]
        rest = pieces - (pieces @ basis) @ basis.T
        found.append(np.sqrt((rest**2).sum(axis=1) / (n - 3)))
    scatter = np.concatenate(found) if found else np.zeros(0)
    scatter = scatter[(scatter > 1e-4) & (scatter < 1.0)]
    if len(scatter) < 50:
        return np.nan
    counts, edges = np.histogram(np.log(scatter), 60, (np.log(1e-4), 0.0))
    peak = gaussian_filter1d(counts.astype(float), 1.5).argmax()
    return float(np.exp((edges[peak] + edges[peak + 1]) / 2))
