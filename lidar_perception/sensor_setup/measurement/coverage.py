"""Coverage of the sensor: its view, blind sectors, and the robot's own body."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lidar_perception.robot.crop import select_points
from lidar_perception.robot.params import CropParams
from lidar_perception.sensor_setup.measurement.beams import Beams
from lidar_perception.sensor_setup.measurement.mount import Mount
from lidar_perception.sensor_setup.measurement.scans import Scan

SECTORS = 360  # sectors of a revolution
NEAR_BODY_M = 1.0  # constant returns this close come from the robot, even if it stands still
MAX_BODY_M = 4.0  # constant returns this close come from the robot if it drives
MAX_ROBOT_SIZE_M = (5.5, 2.6)  # maximum length and width, those of a van
MAX_BODY_SHARE = 0.3  # maximum fraction of all points; more points are walls along the robot's path
MAX_FOREIGN_SHARE = 0.2  # maximum fraction of points in the body box that do not belong to the robot
MIN_BODY_SCANS = 0.7  # minimum fraction of scans with a return from the body
MAX_BODY_VARIATION_M = 0.06  # maximum variation of the body's range
MIN_BODY_HEIGHT_M = 0.15  # minimum height of the body above the ground
MIN_CELLS = 20  # minimum number of (sector, beam) cells of a body; fewer may be chance
MARGIN_M = 0.05  # margin around the body box
# The robot stands still if less than MAX_CHANGED_SHARE of the returns beyond MIN_FAR_M change their
# range by MIN_CHANGE_M between these quantiles of the scans (extremes are people passing by).
MIN_FAR_M, MIN_CHANGE_M, QUANTILES, MAX_CHANGED_SHARE = 4.0, 0.3, (0.1, 0.9), 0.3
MAX_GROUND_RANGE_M = 30.0  # maximum range at which the ground reliably returns
MIN_BLIND = 3  # minimum width of a blind sector in degrees; narrower gaps may be chance
MIN_SEEN_SHARE = 0.35  # minimum fraction of sectors with a return for a beam that can show blind sectors
ROW_STEP = 2.0  # elevation step between rows if there are no beams, in degrees


class Coverage(NamedTuple):
    """Field of view and occlusions of a sensor, on a grid of R rows (beams) and 360 sectors.

    Attributes:
        rows: (R,) elevations in degrees of the beams, or of rows without beams, descending.
        return_share: (R, 360) share of the scans with a return.
        body: (R, 360) bool, returns of the robot itself.
        box: (6,) box around the body's points, lower then upper corner, m; empty without any.
        foreign_share: Share of the points in the box that are not the body's.
        body_share: Share of all points that are the body's.
        has_walls: The constant returns are too many for a robot's body, for example because of walls
            along its path. Then only returns within NEAR_BODY_M count as body.
        stationary: The robot stands still; None if unknown.
        blocked: (first row, from, to) of blind sectors, degrees counter-clockwise.
        view: (from, to) of the azimuths with returns, degrees.
    """

    rows: np.ndarray
    return_share: np.ndarray
    body: np.ndarray
    box: np.ndarray
    foreign_share: float
    body_share: float
    has_walls: bool
    stationary: bool | None
    blocked: list[tuple[int, float, float]]
    view: tuple[float, float]

    @property
    def can_crop(self) -> bool:
        """True if cropping the box removes little but the body: no walls, few other points or a small box."""
        return (
            len(self.box) > 0
            and not self.has_walls
            and (self.foreign_share <= MAX_FOREIGN_SHARE or float(np.abs(self.box).max()) < NEAR_BODY_M)
        )


class NearestReturns(NamedTuple):
    """Nearest return of each cell in S scans, on a grid of R rows and 360 sectors.

    Attributes:
        rows: (R,) elevations, see Coverage.
        labels: Row of each point of each scan, (N,) int64, -1 for none.
        ranges: (S, R, 360) float32 range of the nearest return in m, inf without one.
    """

    rows: np.ndarray
    labels: list[np.ndarray]
    ranges: np.ndarray


def find_nearest_returns(scans: Sequence[Scan], beams: Beams | None) -> NearestReturns:
    """Find the nearest return of each scan in each cell."""
    rows, labels = _assign_rows(scans, beams)
    ranges = np.full((len(scans), len(rows), SECTORS), np.inf, np.float32)
    for image, scan, label in zip(ranges, scans, labels):
        valid = label >= 0
        np.minimum.at(image, (label[valid], _to_sectors(scan)[valid]), scan.range[valid].astype(np.float32))
    return NearestReturns(rows, labels, ranges)


def measure_coverage(
    scans: Sequence[Scan], nearest: NearestReturns, mount: Mount | None, stationary: bool | None
) -> Coverage:
    """Measure field of view, blind sectors and the robot's body on all scans together.

    Args:
        mount: Mount of the sensor; None if unknown.
        stationary: The robot stands still; None if unknown.
    """
    rows, labels, ranges = nearest
    return_share = np.isfinite(ranges).mean(axis=0)
    body, middle = _find_body(ranges, rows, mount, stationary)
    own, box = _select_body(scans, labels, body, middle)
    total = sum(len(scan.xyz) for scan in scans)
    wide, long = np.sort(box[3:5] - box[:2]) if len(box) else (0.0, 0.0)
    has_walls = bool(
        long > MAX_ROBOT_SIZE_M[0] or wide > MAX_ROBOT_SIZE_M[1] or sum(m.sum() for m in own) > MAX_BODY_SHARE * total
    )
    if has_walls:
        body = _drop_small(body & (middle < NEAR_BODY_M))
        own, box = _select_body(scans, labels, body, middle)
    # A cell without returns is blind only if it points to the ground; others may point to the sky.
    sees_ground = (
        np.zeros(return_share.shape, bool)
        if mount is None
        else (_cell_directions(rows) @ mount.normal * MAX_GROUND_RANGE_M < -mount.height)
    )
    sees_ground |= not sees_ground.any()  # no cell reaches the ground, for example on a tall vehicle
    open_ = (return_share > 0).any(axis=0) | ~sees_ground.any(axis=0)
    inside = [~select_points(scan.xyz, CropParams(body=tuple(box.tolist()))) for scan in scans]
    foreign = float(sum((i & ~m).sum() for i, m in zip(inside, own)) / max(1, sum(i.sum() for i in inside)))
    coverage = Coverage(
        rows,
        return_share,
        body,
        box,
        foreign,
        sum(m.sum() for m in own) / max(1, total),
        has_walls,
        stationary,
        [],
        _find_view(open_),
    )
    # If the robot stands still, the constant returns may be a person next to it.
    hiding = body & (coverage.can_crop and stationary is False)
    return coverage._replace(
        blocked=_find_blocked(((return_share == 0) & sees_ground) | hiding, open_, return_share, hiding)
    )


def _select_body(
    scans: Sequence[Scan], labels: Sequence[np.ndarray], body: np.ndarray, middle: np.ndarray
) -> tuple[list[np.ndarray], np.ndarray]:
    """Select the points of the body: in its cells (R, 360), at their median range (R, 360).

    Returns:
        (N,) bool for each scan, and the box (6,) around these points, empty without points.
    """
    own = [
        _look_up(scan, label, body, False)
        & (np.abs(scan.range - _look_up(scan, label, middle, 0.0)) < 3 * MAX_BODY_VARIATION_M)
        for scan, label in zip(scans, labels)
    ]
    points = np.concatenate([scan.xyz[m] for scan, m in zip(scans, own)])
    if not len(points):
        return own, np.zeros(0)
    # Percentiles, so that a few returns next to the body do not widen the box.
    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    return own, np.concatenate([low - MARGIN_M, high + MARGIN_M])


def _assign_rows(scans: Sequence[Scan], beams: Beams | None) -> tuple[np.ndarray, list[np.ndarray]]:
    if beams is not None:
        return beams.elevations, beams.labels
    rows = np.arange(90.0 - ROW_STEP / 2, -90.0, -ROW_STEP)
    return rows, [np.clip(((90.0 - scan.elevation) / ROW_STEP).astype(int), 0, len(rows) - 1) for scan in scans]


def _to_sectors(scan: Scan) -> np.ndarray:
    return (scan.azimuth * (SECTORS / 360)).astype(int) % SECTORS


def _look_up(scan: Scan, labels: np.ndarray, cells: np.ndarray, default: float) -> np.ndarray:
    """Return the value of each point's cell in cells (R, 360), as (N,); default for points without a row."""
    return np.where(labels >= 0, cells[labels, _to_sectors(scan)], default).astype(cells.dtype)


def is_stationary(ranges: np.ndarray) -> bool | None:
    """Return True if most far returns are constant, which shows that the robot stands still.

    Args:
        ranges: (S, R, 360) ranges of S scans in m, inf without a return.

    Returns:
        True or False; None for a single scan, or with too few far returns.
    """
    if len(ranges) < 2:
        return None
    count = np.isfinite(ranges).sum(axis=0)
    frequent = count >= max(2, 0.6 * len(ranges))
    ordered, last = np.sort(ranges[:, frequent], axis=0), count[frequent] - 1
    first, last = (
        np.take_along_axis(ordered, np.round(share * last).astype(int)[None], axis=0)[0] for share in QUANTILES
    )
    far = first + last > 2 * MIN_FAR_M
    if far.sum() < 100:
        return None
    return bool(((last - first)[far] > MIN_CHANGE_M).mean() < MAX_CHANGED_SHARE)


def _find_body(
    ranges: np.ndarray, rows: np.ndarray, mount: Mount | None, stationary: bool | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the cells with a constant near return, (R, 360) bool, and the median ranges (R, 360)."""
    has_return = np.isfinite(ranges)
    filled = np.where(has_return, ranges, np.nan)
    filled[:, ~has_return.any(axis=0)] = 1e9
    median = np.nanmedian(filled, axis=0)
    variation = np.nanmedian(np.abs(filled - median), axis=0)
    constant = (has_return.mean(axis=0) >= MIN_BODY_SCANS) & (variation <= MAX_BODY_VARIATION_M) & (len(ranges) >= 3)
    if stationary is False and len(ranges) >= 5 and mount is not None:  # else the floor would count
        body = constant & (median < MAX_BODY_M)
        body &= median * (_cell_directions(rows) @ mount.normal) + mount.height > MIN_BODY_HEIGHT_M
    else:
        body = constant & (median < NEAR_BODY_M)
    return _drop_small(body), median


def _drop_small(body: np.ndarray) -> np.ndarray:
    return body if body.sum() >= MIN_CELLS else np.zeros_like(body)


def _cell_directions(rows: np.ndarray) -> np.ndarray:
    """Return (R, 360, 3) unit vectors to the cells in the sensor's frame."""
    up, aside = np.radians(rows)[:, None], np.radians(np.arange(SECTORS) + 0.5)
    return np.stack(np.broadcast_arrays(np.cos(up) * np.cos(aside), np.cos(up) * np.sin(aside), np.sin(up)), axis=-1)


def _find_blocked(
    blind: np.ndarray, open_: np.ndarray, return_share: np.ndarray, body: np.ndarray
) -> list[tuple[int, float, float]]:
    """Find sectors in which a beam and all lower beams are blind; outside open_ (360,), all beams are.

    Beams with few returns, such as those into the sky, cannot show blind sectors and are ignored.

    Returns:
        (first row, from, to) of each sector, in degrees.
    """
    informative = (
        (return_share[:, open_] > 0).mean(axis=1) >= MIN_SEEN_SHARE
        if open_.any()
        else np.zeros(len(return_share), bool)
    )
    if not informative.any():
        return []
    # The lowest informative beam with a return in each sector.
    hidden = np.where(informative[:, None], blind, True)
    lowest = len(blind) - np.cumprod(hidden[::-1], axis=0).sum(axis=0)
    candidates = np.append(np.flatnonzero(informative), len(blind))
    first = candidates[np.searchsorted(candidates, lowest)]
    for row in range(len(blind) - 2, -1, -1):  # the body blocks informative and other beams alike
        first = np.where((first == row + 1) & body[row], row, first)
    first = np.where(open_, first, 0)
    out = []
    step = max(1, len(blind) // 16)  # coarse rows, so that adjacent sectors merge
    level = np.where(first < len(blind), -(-first // step) * step, len(blind))
    level = np.minimum(level, np.where(first < len(blind), len(blind) - 1, len(blind)))
    turn = int(np.argmax(np.diff(level, prepend=level[-1]) != 0))
    rolled = np.roll(level, -turn)
    starts = np.flatnonzero(np.diff(rolled, prepend=-1) != 0)
    for start, end in zip(starts, [*starts[1:], SECTORS]):
        if rolled[start] < len(blind) and end - start >= MIN_BLIND:
            out.append((int(rolled[start]), float((start + turn) % 360), float((end + turn - 1) % 360 + 1)))
    return sorted(out)


def _find_view(open_: np.ndarray) -> tuple[float, float]:
    """Return the field of view (from, to) in degrees, which leaves out the widest gap; (0, 360) without a gap."""
    if not open_.any() or open_.all():
        return 0.0, 360.0
    turn = int(np.argmax(open_))
    rolled = np.roll(open_, -turn)
    edges = np.flatnonzero(np.diff(rolled.astype(int), append=1))
    falls, rises = edges[0::2], edges[1::2]
    widest = int(np.argmax(rises - falls))
    if rises[widest] - falls[widest] < MIN_BLIND:
        return 0.0, 360.0
    return float((rises[widest] + 1 + turn) % 360), float((falls[widest] + 1 + turn) % 360)
