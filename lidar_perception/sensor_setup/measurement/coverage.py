"""Coverage of a sensor: its field of view, blind sectors, and returns from the robot's body."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lidar_perception.robot.crop import select_points
from lidar_perception.robot.params import CropParams
from lidar_perception.sensor_setup.measurement.beams import Beams
from lidar_perception.sensor_setup.measurement.mount import Mount
from lidar_perception.sensor_setup.measurement.scans import Scan

SECTORS = 360  # number of sectors per revolution
NEAR_BODY_M = 1.0  # range below which constant returns come from the robot, even if it stands still
MAX_BODY_M = 4.0  # range below which constant returns come from the robot while it drives
MAX_ROBOT_SIZE_M = (5.5, 2.6)  # maximum length and width of a robot: a van
MAX_BODY_FRACTION = 0.3  # maximum fraction of points on the body; with more, walls are among them
MAX_FOREIGN_FRACTION = 0.2  # maximum fraction of points in the body box that do not belong to the robot
MIN_BODY_FRACTION = 0.7  # minimum fraction of scans with a return from the body
MAX_BODY_VARIATION_M = 0.06  # maximum variation of the body's range
MIN_BODY_HEIGHT_M = 0.15  # minimum height of the body above the ground
MIN_CELLS = 20  # minimum number of (sector, beam) cells of a body; fewer may be chance
MARGIN_M = 0.05  # margin around the body box
# The robot stands still if, beyond MIN_FAR_M, the range of less than MAX_CHANGED_FRACTION of the cells
# changes by MIN_CHANGE_M between these quantiles of the scans. Quantiles exclude people who pass by.
MIN_FAR_M, MIN_CHANGE_M, QUANTILES, MAX_CHANGED_FRACTION = 4.0, 0.3, (0.1, 0.9), 0.3
MAX_GROUND_RANGE_M = 30.0  # maximum range of reliable returns from the ground
MIN_BLIND = 3  # minimum width of a blind sector in degrees; narrower gaps may be chance
MIN_SEEN_FRACTION = 0.35  # minimum fraction of sectors with returns for a beam that can show blind sectors
ROW_STEP = 2.0  # elevation step between rows if there are no beams, in degrees


class Coverage(NamedTuple):
    """Field of view and occlusions of a sensor, on a grid of R rows (beams) and 360 sectors.

    Attributes:
        rows: (R,) elevations in degrees of the beams, or of rows without beams, descending.
        return_fraction: (R, 360) fraction of the scans with a return.
        body: (R, 360) bool, cells with returns from the robot itself.
        box: (6,) box around the points on the body, lower then upper corner, m; empty without points.
        foreign_fraction: Fraction of the points in the box that are not on the body.
        body_fraction: Fraction of all points that are on the body.
        has_walls: True if there are too many constant returns for the body of a robot, for example
            because of walls along its path. Then only returns within NEAR_BODY_M count as body.
        stationary: True if the robot stands still; None if unknown.
        blocked: (first row, from, to) of each blind sector, degrees counter-clockwise.
        view: (from, to) of the azimuths with returns, degrees.
    """

    rows: np.ndarray
    return_fraction: np.ndarray
    body: np.ndarray
    box: np.ndarray
    foreign_fraction: float
    body_fraction: float
    has_walls: bool
    stationary: bool | None
    blocked: list[tuple[int, float, float]]
    view: tuple[float, float]

    @property
    def can_crop(self) -> bool:
        """True if cropping the box removes few other points: no walls, and few foreign points or a small box."""
        return (
            len(self.box) > 0
            and not self.has_walls
            and (self.foreign_fraction <= MAX_FOREIGN_FRACTION or float(np.abs(self.box).max()) < NEAR_BODY_M)
        )


class NearestReturns(NamedTuple):
    """Nearest return of each cell in S scans, on a grid of R rows and 360 sectors.

    Attributes:
        rows: (R,) elevations, see Coverage.
        labels: Row of each point, -1 for none; one array (N,) int64 per scan.
        ranges: (S, R, 360) float32 range of the nearest return in m, inf without one.
    """

    rows: np.ndarray
    labels: list[np.ndarray]
    ranges: np.ndarray


def find_nearest_returns(scans: Sequence[Scan], beams: Beams | None) -> NearestReturns:
    """Find the nearest return in each cell of each scan."""
    rows, labels = _assign_rows(scans, beams)
    ranges = np.full((len(scans), len(rows), SECTORS), np.inf, np.float32)
    for image, scan, label in zip(ranges, scans, labels):
        has_row = label >= 0
        np.minimum.at(image, (label[has_row], _to_sectors(scan)[has_row]), scan.range[has_row].astype(np.float32))
    return NearestReturns(rows, labels, ranges)


def measure_coverage(
    scans: Sequence[Scan], nearest_returns: NearestReturns, mount: Mount | None, stationary: bool | None
) -> Coverage:
    """Measure the field of view, blind sectors and the robot's body from all scans together.

    Args:
        nearest_returns: Nearest returns of the scans.
        mount: Mount of the sensor; None if unknown.
        stationary: True if the robot stands still; None if unknown.
    """
    rows, labels, ranges = nearest_returns
    return_fraction = np.isfinite(ranges).mean(axis=0)
    body, median = _find_body(ranges, rows, mount, stationary)
    masks, box = _select_body(scans, labels, body, median)
    total = sum(len(scan.xyz) for scan in scans)
    width, length = np.sort(box[3:5] - box[:2]) if len(box) else (0.0, 0.0)
    has_walls = bool(
        length > MAX_ROBOT_SIZE_M[0]
        or width > MAX_ROBOT_SIZE_M[1]
        or sum(m.sum() for m in masks) > MAX_BODY_FRACTION * total
    )
    if has_walls:
        body = _drop_small(body & (median < NEAR_BODY_M))
        masks, box = _select_body(scans, labels, body, median)
    # Only cells that point to the ground can be blind. Others without returns may point to the sky.
    is_towards_ground = (
        np.zeros(return_fraction.shape, bool)
        if mount is None
        else (_compute_cell_directions(rows) @ mount.normal * MAX_GROUND_RANGE_M < -mount.height)
    )
    if not is_towards_ground.any():  # on a tall vehicle, no cell may reach the ground
        is_towards_ground[:] = True
    in_view = (return_fraction > 0).any(axis=0) | ~is_towards_ground.any(axis=0)
    in_box = [~select_points(scan.xyz, CropParams(body=tuple(box.tolist()))) for scan in scans]
    foreign_fraction = float(sum((i & ~m).sum() for i, m in zip(in_box, masks)) / max(1, sum(i.sum() for i in in_box)))
    coverage = Coverage(
        rows,
        return_fraction,
        body,
        box,
        foreign_fraction,
        sum(m.sum() for m in masks) / max(1, total),
        has_walls,
        stationary,
        [],
        _find_view(in_view),
    )
    # If the robot stands still, constant returns may come from a person next to it.
    hidden_by_body = body & (coverage.can_crop and stationary is False)
    return coverage._replace(
        blocked=_find_blocked(
            ((return_fraction == 0) & is_towards_ground) | hidden_by_body, in_view, return_fraction, hidden_by_body
        )
    )


def _select_body(
    scans: Sequence[Scan], labels: Sequence[np.ndarray], body: np.ndarray, median: np.ndarray
) -> tuple[list[np.ndarray], np.ndarray]:
    """Return a mask (N,) of the points on the body for each scan, and the box (6,) around them, empty if none."""
    masks = [
        _look_up(scan, label, body, False)
        & (np.abs(scan.range - _look_up(scan, label, median, 0.0)) < 3 * MAX_BODY_VARIATION_M)
        for scan, label in zip(scans, labels)
    ]
    points = np.concatenate([scan.xyz[mask] for scan, mask in zip(scans, masks)])
    if not len(points):
        return masks, np.zeros(0)
    # Percentiles exclude a few returns next to the body.
    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    return masks, np.concatenate([low - MARGIN_M, high + MARGIN_M])


def _assign_rows(scans: Sequence[Scan], beams: Beams | None) -> tuple[np.ndarray, list[np.ndarray]]:
    if beams is not None:
        return beams.elevations, beams.labels
    rows = np.arange(90.0 - ROW_STEP / 2, -90.0, -ROW_STEP)
    return rows, [np.clip(((90.0 - scan.elevation) / ROW_STEP).astype(int), 0, len(rows) - 1) for scan in scans]


def _to_sectors(scan: Scan) -> np.ndarray:
    return (scan.azimuth * (SECTORS / 360)).astype(int) % SECTORS


def _look_up(scan: Scan, labels: np.ndarray, cells: np.ndarray, default: float) -> np.ndarray:
    """Return the value (N,) of each point's cell in cells (R, 360); `default` for points without a row."""
    return np.where(labels >= 0, cells[labels, _to_sectors(scan)], default).astype(cells.dtype)


def is_stationary(ranges: np.ndarray) -> bool | None:
    """Return True if the robot stands still: most far returns have a constant range.

    Args:
        ranges: (S, R, 360) ranges of S scans in m, inf without a return.

    Returns:
        None for a single scan, or if there are too few far returns.
    """
    if len(ranges) < 2:
        return None
    count = np.isfinite(ranges).sum(axis=0)
    is_frequent = count >= max(2, 0.6 * len(ranges))
    sorted_ranges, high = np.sort(ranges[:, is_frequent], axis=0), count[is_frequent] - 1
    low, high = (
        np.take_along_axis(sorted_ranges, np.round(quantile * high).astype(int)[None], axis=0)[0]
        for quantile in QUANTILES
    )
    is_far = low + high > 2 * MIN_FAR_M
    if is_far.sum() < 100:
        return None
    return bool(((high - low)[is_far] > MIN_CHANGE_M).mean() < MAX_CHANGED_FRACTION)


def _find_body(
    ranges: np.ndarray, rows: np.ndarray, mount: Mount | None, stationary: bool | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the cells of the body, which have constant near returns, and the median ranges, (R, 360) each."""
    has_return = np.isfinite(ranges)
    padded_ranges = np.where(has_return, ranges, np.nan)
    padded_ranges[:, ~has_return.any(axis=0)] = 1e9
    median = np.nanmedian(padded_ranges, axis=0)
    variation = np.nanmedian(np.abs(padded_ranges - median), axis=0)
    is_constant = (
        (has_return.mean(axis=0) >= MIN_BODY_FRACTION) & (variation <= MAX_BODY_VARIATION_M) & (len(ranges) >= 3)
    )
    if stationary is False and len(ranges) >= 5 and mount is not None:  # the mount excludes the floor
        body = is_constant & (median < MAX_BODY_M)
        body &= median * (_compute_cell_directions(rows) @ mount.normal) + mount.height > MIN_BODY_HEIGHT_M
    else:
        body = is_constant & (median < NEAR_BODY_M)
    return _drop_small(body), median


def _drop_small(body: np.ndarray) -> np.ndarray:
    return body if body.sum() >= MIN_CELLS else np.zeros_like(body)


def _compute_cell_directions(rows: np.ndarray) -> np.ndarray:
    """Return unit vectors (R, 360, 3) to the cells in the sensor's frame."""
    elevation, azimuth = np.radians(rows)[:, None], np.radians(np.arange(SECTORS) + 0.5)
    x, y = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)
    return np.stack(np.broadcast_arrays(x, y, np.sin(elevation)), axis=-1)


def _find_blocked(
    is_blind: np.ndarray, in_view: np.ndarray, return_fraction: np.ndarray, body: np.ndarray
) -> list[tuple[int, float, float]]:
    """Find sectors in which a beam and all lower beams are blind.

    Beams with few returns, such as those into the sky, cannot show blind sectors and are ignored.

    Args:
        is_blind: (R, 360) bool, cells without a view.
        in_view: (360,) bool; in all other sectors, all beams are blind.
        return_fraction: See Coverage.
        body: (R, 360) bool, cells that the body hides.

    Returns:
        (first row, from, to) of each sector, in degrees.
    """
    row_count = len(is_blind)
    is_informative = (
        (return_fraction[:, in_view] > 0).mean(axis=1) >= MIN_SEEN_FRACTION
        if in_view.any()
        else np.zeros(len(return_fraction), bool)
    )
    if not is_informative.any():
        return []
    # The lowest informative beam with a return in each sector.
    is_hidden = np.where(is_informative[:, None], is_blind, True)
    lowest_row = row_count - np.cumprod(is_hidden[::-1], axis=0).sum(axis=0)
    candidates = np.append(np.flatnonzero(is_informative), row_count)
    first_row = candidates[np.searchsorted(candidates, lowest_row)]
    for row in range(row_count - 2, -1, -1):  # add rows that the body hides
        first_row = np.where((first_row == row + 1) & body[row], row, first_row)
    first_row = np.where(in_view, first_row, 0)
    sectors = []
    step = max(1, row_count // 16)  # rounding of rows, so that adjacent sectors merge
    level = np.where(first_row < row_count, -(-first_row // step) * step, row_count)
    level = np.minimum(level, np.where(first_row < row_count, row_count - 1, row_count))
    shift = int(np.argmax(np.diff(level, prepend=level[-1]) != 0))
    rolled_levels = np.roll(level, -shift)
    starts = np.flatnonzero(np.diff(rolled_levels, prepend=-1) != 0)
    for start, end in zip(starts, [*starts[1:], SECTORS]):
        if rolled_levels[start] < row_count and end - start >= MIN_BLIND:
            sectors.append(
                (int(rolled_levels[start]), float((start + shift) % 360), float((end + shift - 1) % 360 + 1))
            )
    return sorted(sectors)


def _find_view(in_view: np.ndarray) -> tuple[float, float]:
    """Return the field of view (from, to) in degrees: all but the widest gap; (0, 360) without a gap."""
    if not in_view.any() or in_view.all():
        return 0.0, 360.0
    shift = int(np.argmax(in_view))
    rolled_view = np.roll(in_view, -shift)
    edges = np.flatnonzero(np.diff(rolled_view.astype(int), append=1))
    ends, starts = edges[0::2], edges[1::2]
    widest_gap = int(np.argmax(starts - ends))
    if starts[widest_gap] - ends[widest_gap] < MIN_BLIND:
        return 0.0, 360.0
    return float((starts[widest_gap] + 1 + shift) % 360), float((ends[widest_gap] + 1 + shift) % 360)
