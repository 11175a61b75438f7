"""Measurement of the beams of a sensor: elevations, beam of each point, azimuth step and range noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks, peak_prominences

from lidar_perception.sensor_setup.measurement.scans import Scan

MIN_BEAM_POINTS = 30  # minimum number of points of a beam in a scan
MAX_BEAMS = 300
BIN_WIDTH = 0.02  # bin width of the elevation histogram, in degrees
MIN_RANGE_M = 2.0  # minimum range; the elevations of nearer points depend on the origin of the beam
# Maximum median scatter of the points of a beam in degrees, by the method that identified the beams.
MAX_SPREAD = {"ring": 3.0, "order": 0.12, "elevation": 0.01}
MIN_PEAK_FRACTION = 0.75  # minimum fraction of points near a peak of the histogram
MIN_COUNT_FRACTION = 0.2  # minimum fraction of scans that must agree on a number of beams
SECTORS = 72  # number of sectors per revolution
MAX_LIFT_ERROR_M = 0.01  # maximum error of a reliable lift
MIN_LIFT_M = 0.03  # minimum lift; smaller ones are measurement errors
MAX_LIFT_M = 0.5  # maximum lift; no sensor is larger
ANGLE_RESOLUTION = 1e-3  # rounding of angles, in degrees
MAX_GAP_STEPS = 3.5  # maximum gap, in azimuth steps, that is used to measure the azimuth step
SEGMENT_POINTS = 9  # number of neighbouring returns to which a parabola is fitted


class Beams(NamedTuple):
    """B beams from the highest to the lowest.

    Attributes:
        elevations: (B,) degrees.
        lifts: (B,) z of the origin of each beam, m; all 0 if the beams have the same origin.
        spread: (B,) median deviation of a beam's points from its elevation, degrees.
        error: (B,) standard error of the elevation, degrees.
        labels: Beam of each point, -1 for none; one array (N,) int64 per scan.
        method: How beams were identified: "ring", "order" or "elevation".
    """

    elevations: np.ndarray
    lifts: np.ndarray
    spread: np.ndarray
    error: np.ndarray
    labels: list[np.ndarray]
    method: str


def find_beams(scans: Sequence[Scan]) -> Beams | None:
    """Find the beams of a sensor that spins about its z axis.

    Returns:
        The beams; None if the scan pattern does not repeat, or the frame of the cloud is tilted
        relative to the sensor.
    """
    for method, label in (("ring", _label_by_ring), ("order", _label_by_order), ("elevation", _label_by_elevation)):
        labels = label(scans)
        if labels is None:
            continue
        beams = _fit_beams(scans, labels, method)
        if beams is None or len(beams.elevations) < 2:
            continue
        # Rejects non-repeating patterns, which have no beams even if the cloud has a ring column.
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
    """Label points by their order in clouds that are sorted by beam, as in KITTI."""
    labels = []
    for scan in scans:
        best: tuple[float, np.ndarray] | None = None
        for seam in (0.0, 180.0, float(scan.azimuth[0]) - 0.5):
            azimuth = (scan.azimuth - seam) % 360.0
            step = np.diff(azimuth)
            forward_step = step if np.median(step) >= 0 else -step
            starts = forward_step < -30.0  # a jump back, where the next beam starts
            count = int(starts.sum()) + 1
            if (
                not 4 <= count <= MAX_BEAMS
                or len(azimuth) / count < MIN_BEAM_POINTS
                or ((forward_step < 0).mean() > 0.1)
            ):
                continue
            label = np.concatenate([[0], np.cumsum(starts)])
            parts = np.split(scan.elevation, np.flatnonzero(starts) + 1)
            spread = float(np.median([_mad(part) for part in parts[::4] if len(part) >= MIN_BEAM_POINTS] or [np.inf]))
            if best is None or spread < best[0]:
                best = spread, label
        if best is None:
            return None
        labels.append(best[1])
    # In scans with fewer beams, the labels after a beam without points are wrong. Only scans with the
    # largest common number of beams are used.
    fractions = np.bincount([int(label[-1]) for label in labels]) / len(labels)
    last_beam = int(np.flatnonzero(fractions >= min(MIN_COUNT_FRACTION, fractions.max())).max())
    return [label if label[-1] == last_beam else np.full(len(label), -1) for label in labels]


def _label_by_elevation(scans: Sequence[Scan]) -> list[np.ndarray] | None:
    """Label points by the peaks of the histogram of elevations."""
    far_elevations = [scan.elevation[scan.range > MIN_RANGE_M] for scan in scans]
    elevations = [scan.elevation for scan in scans]
    points = np.concatenate(
        far_elevations if sum(map(len, far_elevations)) > 0.3 * sum(map(len, elevations)) else elevations
    )
    edges = np.arange(-90.0, 90.0 + BIN_WIDTH, BIN_WIDTH)
    counts = gaussian_filter1d(np.histogram(points, edges)[0].astype(float), 1.0)
    # Thresholds are relative to several peaks: the highest may be two beams with the same elevation.
    reference = np.sort(counts)[-20:].mean()
    peaks, _ = find_peaks(counts, height=0.01 * reference, prominence=0.005 * reference)
    isolated_peaks = [p for p, q in zip(peaks, peak_prominences(counts, peaks)[0]) if q > 0.5 * counts[p]]
    if not 2 <= len(isolated_peaks) <= MAX_BEAMS:
        return None
    centers = (edges[:-1] + edges[1:])[isolated_peaks] / 2
    borders = np.concatenate([[-90.0], (centers[1:] + centers[:-1]) / 2, [90.0]])
    spacing = float(np.median(np.minimum(np.diff(borders)[1:-1], 2.0) if len(centers) > 2 else np.diff(centers)))
    last_peak = len(centers) - 1
    nearest_peak = np.clip(np.searchsorted(borders, points) - 1, 0, last_peak)
    is_near_peak: np.ndarray = np.abs(points - centers[nearest_peak]) < spacing / 4
    if is_near_peak.mean() < MIN_PEAK_FRACTION:
        return None
    labels = []
    for elevation in elevations:
        nearest_peak = np.clip(np.searchsorted(borders, elevation) - 1, 0, last_peak)
        labels.append(
            np.where(np.abs(elevation - centers[nearest_peak]) < max(spacing / 2, 0.1), last_peak - nearest_peak, -1)
        )
    return labels


class _Points(NamedTuple):
    """Points of one beam in all scans: distance from the z axis (m), z (m), and SECTORS * scan + sector."""

    distance: np.ndarray
    z: np.ndarray
    sector: np.ndarray

    def compute_elevations(self, lift: float) -> np.ndarray:
        """Return the elevations in degrees relative to the point (0, 0, lift)."""
        return np.degrees(np.arctan2(self.z - lift, self.distance))


def _fit_beams(scans: Sequence[Scan], labels: list[np.ndarray], method: str) -> Beams | None:
    label_values = np.unique(np.concatenate([np.unique(label) for label in labels]))
    label_values = label_values[label_values >= 0]
    rows: list[list[_Points]] = [[] for _ in label_values]
    for number, (scan, label) in enumerate(zip(scans, labels)):
        order = np.argsort(label, kind="stable")
        begins, ends = (np.searchsorted(label[order], label_values, side) for side in ("left", "right"))
        for k, (begin, end) in enumerate(zip(begins, ends)):
            if end - begin >= MIN_BEAM_POINTS:
                indices = order[begin:end]
                is_far = scan.ground_range[indices] > MIN_RANGE_M
                indices = indices[is_far] if is_far.sum() >= MIN_BEAM_POINTS else indices
                rows[k].append(
                    _Points(
                        scan.ground_range[indices],
                        scan.xyz[indices, 2],
                        number * SECTORS + (scan.azimuth[indices] * (SECTORS / 360)).astype(int) % SECTORS,
                    )
                )
    has_points = [k for k, row in enumerate(rows) if row]
    if len(has_points) < 2:
        return None
    beams = [_Points(*map(np.concatenate, zip(*rows[k]))) for k in has_points]
    lifts, is_reliable = _fit_lifts(beams)
    elevations, spread, error = (np.empty(len(has_points)) for _ in range(3))
    for n, (beam, lift) in enumerate(zip(beams, lifts)):
        point_elevations = beam.compute_elevations(lift)
        elevations[n], spread[n] = np.median(point_elevations), _mad(point_elevations)
        # The error comes from the scatter between scans, or between quarters of them if there are few.
        group = beam.sector // SECTORS if len(scans) >= 5 else beam.sector // (SECTORS // 4)
        medians = np.array([np.median(point_elevations[group == i]) for i in np.unique(group)])
        error[n] = 1.2533 * 1.4826 * _mad(medians) / np.sqrt(len(medians))
        if lifts.any() and not is_reliable[n]:
            error[n] += np.degrees(MAX_LIFT_ERROR_M / np.median(beam.distance))
    beam_order = np.argsort(-elevations, kind="stable")
    # Beams with equal elevations count as one.
    rank = np.empty(len(has_points), np.int64)
    rank[beam_order] = np.cumsum(np.concatenate([[0], np.diff(-elevations[beam_order]) > ANGLE_RESOLUTION]))
    unique_beams = beam_order[np.unique(rank[beam_order], return_index=True)[1]]
    beam_of_label = np.full(int(label_values.max()) + 2, -1)
    beam_of_label[label_values[has_points]] = rank
    return Beams(
        elevations[unique_beams],
        lifts[unique_beams],
        spread[unique_beams],
        error[unique_beams],
        [beam_of_label[label] for label in labels],
        method,
    )


def _fit_lifts(beams: list[_Points]) -> tuple[np.ndarray, np.ndarray]:
    """Fit the line z = lift + tan(elevation) * distance to the points of each beam.

    Returns:
        lifts: (B,) z of the origin of each beam, m. A beam whose points have too similar distances
            gets the lift of its neighbours. All are 0 if the reliable lifts are below MIN_LIFT_M.
        is_reliable: (B,) bool, True for beams whose lift was measured.
    """
    lift, is_reliable = np.zeros(len(beams)), np.zeros(len(beams), bool)
    for n, beam in enumerate(beams):
        stride = max(1, len(beam.z) // 20_000)
        distance, z = beam.distance[::stride], beam.z[::stride]
        weight = 1.0 / np.maximum(distance, 0.5)  # converts residuals to angles
        is_inlier, residual = np.ones(len(z), bool), np.zeros(len(z))
        for _ in range(4):
            if is_inlier.sum() < MIN_BEAM_POINTS:
                break
            design = np.column_stack([np.ones(is_inlier.sum()), distance[is_inlier]]) * weight[is_inlier, None]
            (lift[n], slope), *_ = np.linalg.lstsq(design, z[is_inlier] * weight[is_inlier], rcond=None)
            residual = np.abs(z - lift[n] - slope * distance) * weight
            is_inlier = residual <= max(3 * 1.4826 * float(np.median(residual)), 1e-5)
        span = float(np.subtract(*np.percentile(weight, [90, 10])))
        scatter = 1.4826 * float(np.median(residual))
        # Returns in the same sector are correlated and count as one.
        is_reliable[n] = span > 0.04 and scatter / span / np.sqrt(len(np.unique(beam.sector))) < MAX_LIFT_ERROR_M
    if not is_reliable.any() or np.median(np.abs(lift[is_reliable])) < MIN_LIFT_M:
        return np.zeros(len(beams)), is_reliable
    references = np.flatnonzero(is_reliable)
    for n in np.flatnonzero(~is_reliable).tolist():
        lift[n] = np.median(lift[references[np.argsort(np.abs(references - n))[:5]]])
    return lift, is_reliable


def _mad(values: np.ndarray) -> float:
    return float(np.median(np.abs(values - np.median(values)))) if len(values) else np.inf


def measure_azimuth_step(scans: Sequence[Scan], beams: Beams) -> tuple[float, float]:
    """Measure the azimuth step and the fraction of second returns.

    Returns:
        step: Angle between neighbouring firings of a beam in degrees, median over beams and scans;
            NaN if no beam has enough points.
        second_returns: Fraction of points with the same azimuth as their neighbour.
    """
    steps, second_returns = [], []
    for scan, label in zip(scans, beams.labels):
        order = np.lexsort((scan.azimuth, label))
        is_far = scan.ground_range[order] > MIN_RANGE_M  # near returns may be off the beam's axis
        order = order[is_far] if is_far.mean() > 0.3 else order
        for azimuth in np.split(scan.azimuth[order], np.flatnonzero(np.diff(label[order])) + 1):
            gaps = np.diff(azimuth)
            if len(azimuth) < MIN_BEAM_POINTS:
                continue
            second_returns.append(float((gaps < ANGLE_RESOLUTION).mean()))
            gaps = gaps[gaps >= ANGLE_RESOLUTION]
            if len(gaps) < MIN_BEAM_POINTS // 2:
                continue
            # Use the mean, because encoders round azimuths. Gaps with lost returns count as several steps.
            step = float(np.median(gaps))
            for _ in range(3):
                plausible_gaps = gaps[(gaps > 0.4 * step) & (gaps < MAX_GAP_STEPS * step)]
                step = float(plausible_gaps.sum() / np.maximum(1, np.round(plausible_gaps / step)).sum())
            steps.append(step)
    if not steps:
        return np.nan, 0.0
    return float(np.median(steps)), float(np.median(second_returns))


def measure_range_noise(scans: Sequence[Scan], beams: Beams, step: float) -> float:
    """Return the standard deviation of the range on smooth surfaces in m; NaN if unknown.

    Parabolas are fitted to SEGMENT_POINTS neighbouring returns of a beam. The result is the most
    frequent residual, because residuals on rough surfaces are larger.

    Args:
        beams: Beams of their points.
        step: Azimuth step in degrees.
    """
    n = SEGMENT_POINTS
    x = np.linspace(-1, 1, n)
    basis, _ = np.linalg.qr(np.column_stack([np.ones(n), x, x * x]))
    residuals = []
    for scan, label in zip(scans, beams.labels):
        order = np.lexsort((scan.azimuth, label))
        gaps = np.diff(scan.azimuth[order])
        is_next = (np.diff(label[order]) == 0) & (label[order][1:] >= 0) & (gaps < 1.6 * step) & (gaps > 0.2 * step)
        is_segment = np.lib.stride_tricks.sliding_window_view(is_next, n - 1)[::n].all(axis=1)
        segments = np.lib.stride_tricks.sliding_window_view(scan.range[order], n)[::n][is_segment]
        residual = segments - (segments @ basis) @ basis.T
        residuals.append(np.sqrt((residual**2).sum(axis=1) / (n - 3)))
    scatter = np.concatenate(residuals) if residuals else np.zeros(0)
    scatter = scatter[(scatter > 1e-4) & (scatter < 1.0)]
    if len(scatter) < 50:
        return np.nan
    counts, edges = np.histogram(np.log(scatter), 60, (np.log(1e-4), 0.0))
    peak = gaussian_filter1d(counts.astype(float), 1.5).argmax()
    return float(np.exp((edges[peak] + edges[peak + 1]) / 2))
