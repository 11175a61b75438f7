"""Which beam each point is of, and where the beams look."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks, peak_prominences

from lidar_perception.sensor_setup.scans import Scan

MIN_BEAM = 30       # points of a beam in a scan, from which on it is fitted
MAX_BEAMS = 300
BIN = 0.02          # degrees, of the histogram of elevations
NEAR = 2.0          # metres; nearer than this small offsets of a beam turn it much
TIGHT = 0.12        # degrees: points of one beam scatter less about it (median of the beams)
PEAKED = 0.75       # of the points are in the inner half of the space between peaks
STEEP_RING = 3.0    # degrees: a ring column whose points scatter more is none
USUAL = 0.2         # of the scans have so many beams
SECTORS = 72        # of a turn
SMEARED = 0.01      # degrees: beams that scatter more are not told from each other by elevation
MAX_LIFT_ERROR = 0.01  # metres
MIN_LIFT = 0.03     # metres; beams that start nearer to each other start together
MAX_LIFT = 0.5      # metres, more than a sensor is high
FINER = 1e-3        # degrees: how exactly azimuths are told
MAX_GAP = 3.5       # steps, up to which it is told how many returns are lost in a gap


class Beams(NamedTuple):
    """B beams from the highest to the lowest: elevations (B,) degrees; lifts (B,) m on the z axis,
    zeros where all start together; spread (B,) degrees: how far the points of one scatter, the
    median of their distances; error (B,) degrees: of the elevation, from its differences between
    scans (or within one); labels: of each scan (N,) int64, -1 of no beam; how: by what the beams
    were told from each other: ring, order or elevation."""

    elevations: np.ndarray
    lifts: np.ndarray
    spread: np.ndarray
    error: np.ndarray
    labels: list[np.ndarray]
    how: str


def beams_of(scans: Sequence[Scan]) -> Beams | None:
    """The beams of a sensor that turns about z; None where the points lie on no beams, as with a
    sensor whose pattern does not repeat, or in a frame that is turned against the sensor."""
    for how, labelled in (("ring", _by_ring), ("order", _by_order), ("elevation", _by_elevation)):
        labels = labelled(scans)
        if labels is None:
            continue
        found = _fitted(scans, labels, how)
        if found is None or len(found.elevations) < 2:
            continue
        # Points of a scanner whose pattern does not repeat are no beams, whatever its columns say.
        limit = min({"ring": STEEP_RING, "order": TIGHT, "elevation": SMEARED}[how],
                    float(np.median(-np.diff(found.elevations))) / 2)
        if np.median(found.spread) <= limit and np.abs(found.lifts).max() <= MAX_LIFT:
            return found
    return None


def _by_ring(scans: Sequence[Scan]) -> list[np.ndarray] | None:
    rings = [scan.ring for scan in scans if scan.ring is not None]
    if len(rings) < len(scans) or not all(0 <= r.min() and r.max() < MAX_BEAMS for r in rings):
        return None
    return rings if max(len(np.unique(r)) for r in rings) > 1 else None


def _by_order(scans: Sequence[Scan]) -> list[np.ndarray] | None:
    """As in KITTI's files, where the beams stand one after the other, each once around."""
    labels = []
    for scan in scans:
        best: tuple[float, np.ndarray] | None = None
        for seam in (0.0, 180.0, float(scan.azimuth[0]) - 0.5):
            azimuth = (scan.azimuth - seam) % 360.0
            step = np.diff(azimuth)
            turned = step if np.median(step) >= 0 else -step
            starts = turned < -30.0  # back to where a beam begins
            count = int(starts.sum()) + 1
            if not 4 <= count <= MAX_BEAMS or len(azimuth) / count < MIN_BEAM or (
                    (turned < 0).mean() > 0.1):
                continue
            label = np.concatenate([[0], np.cumsum(starts)])
            parts = np.split(scan.elevation, np.flatnonzero(starts) + 1)
            spread = float(np.median([_mad(part) for part in parts[::4] if len(part) >= MIN_BEAM]
                                     or [np.inf]))
            if best is None or spread < best[0]:
                best = spread, label
        if best is None:
            return None
        labels.append(best[1])
    # Where a beam of a scan has no point, those after it would count as others: only the scans with
    # one number of beams count, the greatest that is usual.
    shares = np.bincount([int(label[-1]) for label in labels]) / len(labels)
    usual = int(np.flatnonzero(shares >= min(USUAL, shares.max())).max())
    return [label if label[-1] == usual else np.full(len(label), -1) for label in labels]


def _by_elevation(scans: Sequence[Scan]) -> list[np.ndarray] | None:
    """Beams as peaks of the histogram of elevations."""
    away = [scan.elevation[scan.range > NEAR] for scan in scans]
    whole = [scan.elevation for scan in scans]
    points = np.concatenate(away if sum(map(len, away)) > 0.3 * sum(map(len, whole)) else whole)
    edges = np.arange(-90.0, 90.0 + BIN, BIN)
    counts = gaussian_filter1d(np.histogram(points, edges)[0].astype(float), 1.0)
    # A share of the highest peaks, not of the highest: two beams may look the same way.
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
    if inner.mean() < PEAKED:
        return None
    highest = len(middle) - 1
    reach = np.median(room) / 2
    labels = []
    for elevation in whole:
        k = np.clip(np.searchsorted(borders, elevation) - 1, 0, highest)
        labels.append(np.where(np.abs(elevation - middle[k]) < max(reach, 0.1), highest - k, -1))
    return labels


class _Points(NamedTuple):
    """Points of one beam in all scans: distance m from the axis, z m, the number of their scan and
    sector."""

    distance: np.ndarray
    z: np.ndarray
    place: np.ndarray

    def elevation(self, lift: float) -> np.ndarray:
        return np.degrees(np.arctan2(self.z - lift, self.distance))


def _fitted(scans: Sequence[Scan], labels: list[np.ndarray], how: str) -> Beams | None:
    names = np.unique(np.concatenate([np.unique(label) for label in labels]))
    names = names[names >= 0]
    rows: list[list[_Points]] = [[] for _ in names]
    for number, (scan, label) in enumerate(zip(scans, labels)):
        order = np.argsort(label, kind="stable")
        first, last = (np.searchsorted(label[order], names, side) for side in ("left", "right"))
        for k, (i, j) in enumerate(zip(first, last)):
            if j - i >= MIN_BEAM:
                mine = order[i:j]
                far = scan.ground_range[mine] > NEAR
                mine = mine[far] if far.sum() >= MIN_BEAM else mine
                rows[k].append(_Points(scan.ground_range[mine], scan.xyz[mine, 2],
                                       number * SECTORS + (scan.azimuth[mine] * (SECTORS / 360)
                                                           ).astype(int) % SECTORS))
    known = [k for k, row in enumerate(rows) if row]
    if len(known) < 2:
        return None
    beams = [_Points(*map(np.concatenate, zip(*rows[k]))) for k in known]
    lifts, sure = _lifts(beams)
    elevations, spread, error = (np.empty(len(known)) for _ in range(3))
    for n, (beam, lift) in enumerate(zip(beams, lifts)):
        up = beam.elevation(lift)
        elevations[n], spread[n] = np.median(up), _mad(up)
        # A few scans differ less than what is around one of them.
        part = beam.place // SECTORS if len(scans) >= 5 else beam.place // (SECTORS // 4)
        middles = np.array([np.median(up[part == i]) for i in np.unique(part)])
        error[n] = 1.2533 * 1.4826 * _mad(middles) / np.sqrt(len(middles))
        if lifts.any() and not sure[n]:
            error[n] += np.degrees(MAX_LIFT_ERROR / np.median(beam.distance))
    down = np.argsort(-elevations, kind="stable")
    # Beams that cannot be told apart by their elevations are one, as two with the same angle.
    rank = np.empty(len(known), np.int64)
    rank[down] = np.cumsum(np.concatenate([[0], np.diff(-elevations[down]) > FINER]))
    keep = down[np.unique(rank[down], return_index=True)[1]]
    table = np.full(int(names.max()) + 2, -1)
    table[names[known]] = rank
    return Beams(elevations[keep], lifts[keep], spread[keep], error[keep],
                 [table[label] for label in labels], how)


def _lifts(beams: list[_Points]) -> tuple[np.ndarray, np.ndarray]:
    """(B,) m where each beam starts on the axis: of the line z = lift + tan(elevation) * distance.
    All 0 unless the beams that say it well are apart: those of which the points stand at many
    distances, (B,) bool. The others have the lift of their neighbours."""
    lift, sure = np.zeros(len(beams)), np.zeros(len(beams), bool)
    for n, beam in enumerate(beams):
        every = max(1, len(beam.z) // 20_000)
        distance, z = beam.distance[::every], beam.z[::every]
        weight = 1.0 / np.maximum(distance, 0.5)  # so that residuals are angles
        kept, off = np.ones(len(z), bool), np.zeros(len(z))
        for _ in range(4):
            if kept.sum() < MIN_BEAM:
                break
            a = np.column_stack([np.ones(kept.sum()), distance[kept]]) * weight[kept, None]
            (lift[n], slope), *_ = np.linalg.lstsq(a, z[kept] * weight[kept], rcond=None)
            off = np.abs(z - lift[n] - slope * distance) * weight
            kept = off <= max(3 * 1.4826 * float(np.median(off)), 1e-5)
        reach = float(np.subtract(*np.percentile(weight, [90, 10])))
        scatter = 1.4826 * float(np.median(off))
        # Returns of one sector are alike: they count as one.
        sure[n] = reach > 0.04 and scatter / reach / np.sqrt(
            len(np.unique(beam.place))) < MAX_LIFT_ERROR
    if not sure.any() or np.median(np.abs(lift[sure])) < MIN_LIFT:
        return np.zeros(len(beams)), sure
    known = np.flatnonzero(sure)
    for n in np.flatnonzero(~sure).tolist():
        lift[n] = np.median(lift[known[np.argsort(np.abs(known - n))[:5]]])
    return lift, sure


def _mad(values: np.ndarray) -> float:
    return float(np.median(np.abs(values - np.median(values)))) if len(values) else np.inf


def azimuth_steps(scans: Sequence[Scan], beams: Beams) -> tuple[float, float]:
    """Degrees between neighbouring firings of a beam, the median over beams and scans, and the
    share of points that stand where their neighbour does, as those of a second return. NaN where no
    beam has enough points."""
    steps, twice = [], []
    for scan, label in zip(scans, beams.labels):
        order = np.lexsort((scan.azimuth, label))
        far = scan.ground_range[order] > NEAR  # what is nearer may stand beside the beam's axis
        order = order[far] if far.mean() > 0.3 else order
        for azimuth in np.split(scan.azimuth[order], np.flatnonzero(np.diff(label[order])) + 1):
            apart = np.diff(azimuth)
            if len(azimuth) < MIN_BEAM:
                continue
            twice.append(float((apart < FINER).mean()))
            apart = apart[apart >= FINER]
            if len(apart) < MIN_BEAM // 2:
                continue
            # Encoders tell azimuths in steps of their own, so that gaps differ: their mean counts,
            # and a gap that lost returns leave has the steps of these.
            step = float(np.median(apart))
            for _ in range(3):
                near = apart[(apart > 0.4 * step) & (apart < MAX_GAP * step)]
                step = float(near.sum() / np.maximum(1, np.round(near / step)).sum())
            steps.append(step)
    if not steps:
        return np.nan, 0.0
    return float(np.median(steps)), float(np.median(twice))


def range_noise(scans: Sequence[Scan], beams: Beams, step: float) -> tuple[float, int]:
    """Metres: the standard deviation of ranges about a smooth surface, and of how many pieces. A
    beam is cut into pieces of nine neighbouring returns, each is fitted by a parabola; the pieces
    on rough things scatter more, so that the peak of their distribution counts."""
    n = 9
    x = np.linspace(-1, 1, n)
    basis, _ = np.linalg.qr(np.column_stack([np.ones(n), x, x * x]))
    found = []
    for scan, label in zip(scans, beams.labels):
        order = np.lexsort((scan.azimuth, label))
        gaps = np.diff(scan.azimuth[order])
        follows = (np.diff(label[order]) == 0) & (label[order][1:] >= 0) & (gaps < 1.6 * step) & (
            gaps > 0.2 * step)
        runs = np.lib.stride_tricks.sliding_window_view(follows, n - 1)[::n].all(axis=1)
        pieces = np.lib.stride_tricks.sliding_window_view(scan.range[order], n)[::n][runs]
        rest = pieces - (pieces @ basis) @ basis.T
        found.append(np.sqrt((rest ** 2).sum(axis=1) / (n - 3)))
    scatter = np.concatenate(found) if found else np.zeros(0)
    scatter = scatter[(scatter > 1e-4) & (scatter < 1.0)]
    if len(scatter) < 50:
        return np.nan, len(scatter)
    counts, edges = np.histogram(np.log(scatter), 60, (np.log(1e-4), 0.0))
    peak = gaussian_filter1d(counts.astype(float), 1.5).argmax()
    return float(np.exp((edges[peak] + edges[peak + 1]) / 2)), len(scatter)
