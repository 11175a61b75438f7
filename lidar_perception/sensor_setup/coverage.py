"""What the sensor sees and what it never sees: the robot's own body, and blind sectors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lidar_perception.robot.crop import select_points
from lidar_perception.robot.params import CropParams
from lidar_perception.sensor_setup.beams import Beams
from lidar_perception.sensor_setup.mount import Mount
from lidar_perception.sensor_setup.scans import Scan

SECTORS = 360            # of a turn
ARM = 1.0                # metres; what is nearer in every scan is the robot's, wherever it stands
BODY_REACH = 4.0         # metres; a moving robot's own returns are within this
ROBOT = (5.5, 2.6)       # metres: long and wide is what may be a robot, up to a van
MAX_SHARE = 0.3          # of all points that are the robot's own; more are walls along its way
MAX_OTHERS = 0.2         # share of other points in the box of the robot's body
ALWAYS, STEADY = 0.7, 0.06  # share of the scans with such a return, metres by which it may vary
OFF_GROUND = 0.15        # metres above the ground, from which on a return may be the body's
MIN_CELLS = 20           # of sector and beam; fewer are chance
MARGIN = 0.05            # metres around the body
FAR, CHANGED = 4.0, 0.3  # metres: returns from beyond that differ so much between scans have moved
USUAL = (0.1, 0.9)       # shares of the scans between which returns differ: people pass by
STILL = 0.3              # of them, below which the robot stands still: people move around it
MET = 30.0               # metres: ground that is nearer gives a return
MIN_BLIND = 3            # degrees; narrower gaps are chance
SEEN = 0.35              # of the sectors give a return to a beam that says something of blind ones
ROW = 2.0                # degrees between rows where there are no beams


class Coverage(NamedTuple):
    """rows (R,): elevations in degrees of the beams, or of rows where there are none, descending;
    seen (R, 360): share of the scans with a return there; body (R, 360) bool: returns of the robot
    itself; box (6,) around its points, or empty; others: share of the points in the box that are
    not the body's; body_share: of all points; walls: whether more stays where it is than a robot
    has, as walls along its way do, so that only what is within ARM counts; still: whether the robot
    stood still, None where that cannot be told; blocked: [first row, from, to] in degrees,
    counter-clockwise; view: [from, to] of the azimuths with returns."""

    rows: np.ndarray
    seen: np.ndarray
    body: np.ndarray
    box: np.ndarray
    others: float
    body_share: float
    walls: bool
    still: bool | None
    blocked: list[tuple[int, float, float]]
    view: tuple[float, float]

    @property
    def fits(self) -> bool:
        """Whether the box can be left out: it is not of walls, and few other points are in it, or
        none of it is farther than an arm."""
        return len(self.box) > 0 and not self.walls and (
            self.others <= MAX_OTHERS or float(np.abs(self.box).max()) < ARM)


class Nearest(NamedTuple):
    """rows (R,) as of Coverage; labels: of each scan (N,) int64, the rows of its points, -1 of
    none; ranges (S, R, 360) float32: m of the nearest return in each scan, inf without one."""

    rows: np.ndarray
    labels: list[np.ndarray]
    ranges: np.ndarray


def nearest_of(scans: Sequence[Scan], beams: Beams | None) -> Nearest:
    """What each scan sees, by rows and sectors."""
    rows, labels = _rows(scans, beams)
    near = np.full((len(scans), len(rows), SECTORS), np.inf, np.float32)
    for image, scan, label in zip(near, scans, labels):
        known = label >= 0
        np.minimum.at(image, (label[known], _sectors(scan)[known]),
                      scan.range[known].astype(np.float32))
    return Nearest(rows, labels, near)


def coverage_of(scans: Sequence[Scan], nearest: Nearest, mount: Mount | None,
                still: bool | None) -> Coverage:
    """What all scans together see; still: as stands_still, or more that is known of the robot's
    motion, says."""
    rows, labels, near = nearest
    seen = np.isfinite(near).mean(axis=0)
    body, middle = _body(near, rows, mount, still)
    mine, box = _own(scans, labels, body, middle)
    total = sum(len(scan.xyz) for scan in scans)
    wide, long = np.sort(box[3:5] - box[:2]) if len(box) else (0.0, 0.0)
    walls = bool(long > ROBOT[0] or wide > ROBOT[1]
                 or sum(m.sum() for m in mine) > MAX_SHARE * total)
    if walls:
        body = _enough(body & (middle < ARM))
        mine, box = _own(scans, labels, body, middle)
    # Only what should have met the ground is blind: beams of one that leans look at the sky.
    meets = np.zeros(seen.shape, bool) if mount is None else (
        _ways(rows) @ mount.normal * MET < -mount.height)
    meets |= not meets.any()  # where that cannot be told, as from high above
    open_ = (seen > 0).any(axis=0) | ~meets.any(axis=0)
    inside = [~select_points(scan.xyz, CropParams(body=tuple(box.tolist()))) for scan in scans]
    others = float(sum((i & ~m).sum() for i, m in zip(inside, mine))
                   / max(1, sum(i.sum() for i in inside)))
    found = Coverage(rows, seen, body, box, others, sum(m.sum() for m in mine) / max(1, total),
                     walls, still, [], _view(open_))
    hides = body & (found.fits and still is False)  # else it may be who stands beside the robot
    return found._replace(blocked=_blocked(((seen == 0) & meets) | hides, open_, seen, hides))


def _own(scans: Sequence[Scan], labels: Sequence[np.ndarray], body: np.ndarray,
         middle: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
    """Which points of each scan, (N,) bool, are those of cells of the body (R, 360), at their
    ranges; and the box (6,) around them, or empty."""
    mine = [_at(scan, label, body, False)
            & (np.abs(scan.range - _at(scan, label, middle, 0.0)) < 3 * STEADY)
            for scan, label in zip(scans, labels)]
    points = np.concatenate([scan.xyz[m] for scan, m in zip(scans, mine)])
    if not len(points):
        return mine, np.zeros(0)
    # A few returns from beside the body, such as people who stand there, do not widen the box.
    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    return mine, np.concatenate([low - MARGIN, high + MARGIN])


def _rows(scans: Sequence[Scan], beams: Beams | None) -> tuple[np.ndarray, list[np.ndarray]]:
    if beams is not None:
        return beams.elevations, beams.labels
    rows = np.arange(90.0 - ROW / 2, -90.0, -ROW)
    return rows, [np.clip(((90.0 - scan.elevation) / ROW).astype(int), 0, len(rows) - 1)
                  for scan in scans]


def _sectors(scan: Scan) -> np.ndarray:
    return (scan.azimuth * (SECTORS / 360)).astype(int) % SECTORS


def _at(scan: Scan, labels: np.ndarray, cells: np.ndarray, otherwise: float) -> np.ndarray:
    """(N,) what cells (R, 360) hold where each point is; otherwise for those of no row."""
    return np.where(labels >= 0, cells[labels, _sectors(scan)], otherwise).astype(cells.dtype)


def stands_still(ranges: np.ndarray) -> bool | None:
    """Whether far returns (S, R, 360) m of S scans, inf for none, usually stay where they are; None
    with one scan, or too few such returns."""
    if len(ranges) < 2:
        return None
    count = np.isfinite(ranges).sum(axis=0)
    there = count >= max(2, 0.6 * len(ranges))
    ordered, last = np.sort(ranges[:, there], axis=0), count[there] - 1
    first, last = (np.take_along_axis(ordered, np.round(share * last).astype(int)[None], axis=0)[0]
                   for share in USUAL)
    far = first + last > 2 * FAR
    if far.sum() < 100:
        return None
    return bool(((last - first)[far] > CHANGED).mean() < STILL)


def _body(near: np.ndarray, rows: np.ndarray, mount: Mount | None,
          still: bool | None) -> tuple[np.ndarray, np.ndarray]:
    """(R, 360) bool: cells whose nearest return is always there, near and at the same range; and
    that range."""
    found = np.isfinite(near)
    share = found.mean(axis=0)
    filled = np.where(found, near, np.nan)
    none = ~found.any(axis=0)
    filled[:, none] = 1e9
    middle = np.nanmedian(filled, axis=0)
    varies = np.nanmedian(np.abs(filled - middle), axis=0)
    steady = (share >= ALWAYS) & (varies <= STEADY) & (len(near) >= 3)
    if still is False and len(near) >= 5 and mount is not None:  # else the floor would be body
        body = steady & (middle < BODY_REACH)
        body &= middle * (_ways(rows) @ mount.normal) + mount.height > OFF_GROUND
    else:
        body = steady & (middle < ARM)
    return _enough(body), middle


def _enough(body: np.ndarray) -> np.ndarray:
    return body if body.sum() >= MIN_CELLS else np.zeros_like(body)


def _ways(rows: np.ndarray) -> np.ndarray:
    """(R, 360, 3) unit vectors to the cells, in the sensor's frame."""
    up, aside = np.radians(rows)[:, None], np.radians(np.arange(SECTORS) + 0.5)
    return np.stack(np.broadcast_arrays(np.cos(up) * np.cos(aside), np.cos(up) * np.sin(aside),
                                        np.sin(up)), axis=-1)


def _blocked(blind: np.ndarray, open_: np.ndarray, seen: np.ndarray,
             body: np.ndarray) -> list[tuple[int, float, float]]:
    """Where all beams from one on are blind, as sectors; all of them in what is not open_ (360,).
    Beams that hardly see anything, as those to the sky, say nothing."""
    says = (seen[:, open_] > 0).mean(axis=1) >= SEEN if open_.any() else np.zeros(len(seen), bool)
    if not says.any():
        return []
    # From the lowest beam upwards: the first that sees in each sector, of those that say something.
    hidden = np.where(says[:, None], blind, True)
    lowest = len(blind) - np.cumprod(hidden[::-1], axis=0).sum(axis=0)
    known = np.append(np.flatnonzero(says), len(blind))
    first = known[np.searchsorted(known, lowest)]
    for row in range(len(blind) - 2, -1, -1):  # what meets the robot is hidden, whatever it says
        first = np.where((first == row + 1) & body[row], row, first)
    first = np.where(open_, first, 0)
    out = []
    step = max(1, len(blind) // 16)  # so that neighbours join
    level = np.where(first < len(blind), -(-first // step) * step, len(blind))
    level = np.minimum(level, np.where(first < len(blind), len(blind) - 1, len(blind)))
    turn = int(np.argmax(np.diff(level, prepend=level[-1]) != 0))
    rolled = np.roll(level, -turn)
    starts = np.flatnonzero(np.diff(rolled, prepend=-1) != 0)
    for start, end in zip(starts, [*starts[1:], SECTORS]):
        if rolled[start] < len(blind) and end - start >= MIN_BLIND:
            out.append((int(rolled[start]), float((start + turn) % 360),
                        float((end + turn - 1) % 360 + 1)))
    return sorted(out)


def _view(open_: np.ndarray) -> tuple[float, float]:
    """From the end of the widest gap to its beginning; 0, 360 without a gap."""
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
