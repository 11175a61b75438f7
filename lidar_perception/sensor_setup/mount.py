"""How high the sensor is above the ground, and how it leans."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lidar_perception.data.mount_check import MAX_LEAN_DEG
from lidar_perception.ground.params import ThresholdParams
from lidar_perception.ground.threshold import fit_plane, fit_plane_by_ransac, height_above_plane
from lidar_perception.robot.placement import make_tilted_pose
from lidar_perception.sensor_setup.scans import Scan

# Planes up to this lean against the sensor's own axes; a sensor that leans more has another frame.
STEEP = ThresholdParams(max_slope=45.0, inlier_distance=0.08)
NEAREST, REACH = 0.3, 2.5   # metres; ground is looked for from beyond the robot up to REACH times
MIN_REACH, MAX_REACH = 5.0, 25.0  # the distance of the nearest ground, within these
MIN_SHARE = 0.12            # of the points there on the plane
MIN_POINTS = 60
CLOSE = 0.05                # metres: of the points to which the plane is fitted at last
DEEP, MAX_BEYOND = 0.3, 0.25  # metres below the ground, and how many points as a share of its own
SECTORS = 6                 # of a scan, that are left out in turn for its uncertainty
MIN_HEIGHT = 0.1            # metres; what is nearer is what the sensor stands on
MUCH_MORE = 8.0              # times as many points: a floor overhead, and not a ceiling above one
MIN_EXTENT = 1.5            # metres that the plane reaches at least
LOWERED = 1.0               # metres by which clouds are, so that a floor at their origin is seen


class Plane(NamedTuple):
    """The ground in the sensor's frame: normal (3,) unit vector that points up; height m of the
    sensor above it; error (3,): of height m, roll and pitch rad, from leaving out sectors; xyz[on]
    is on it."""

    normal: np.ndarray
    height: float
    error: np.ndarray
    on: np.ndarray

    @property
    def roll(self) -> float:
        """Radians, as in a URDF's rpy."""
        return float(np.arctan2(self.normal[1], self.normal[2]))

    @property
    def pitch(self) -> float:
        """Radians, as in a URDF's rpy; positive looks down."""
        return float(-np.arcsin(np.clip(self.normal[0], -1.0, 1.0)))


class Mount(NamedTuple):
    """Over F scans: height m, roll and pitch rad; error (3,) of these, standard deviations of the
    medians; spread (3,) from scan to scan, robust standard deviations; planes: of each scan, None
    where no ground was found; upside_down: whether the ground is where the sensor's own z axis
    points."""

    height: float
    roll: float
    pitch: float
    error: np.ndarray
    spread: np.ndarray
    planes: list[Plane | None]
    upside_down: bool

    @property
    def pose(self) -> np.ndarray:
        """(4, 4): takes points of the sensor to a level frame on the ground below it."""
        return make_tilted_pose(self.roll, self.pitch, self.height)

    @property
    def normal(self) -> np.ndarray:
        """(3,) unit vector that points up, in the sensor's frame."""
        return self.pose[2, :3]

    @property
    def level(self) -> bool:
        """Whether z of the sensor points up, but for as much as roads slope."""
        return bool(self.normal[2] >= np.cos(np.radians(MAX_LEAN_DEG)))


def ground_plane(xyz: np.ndarray, below: bool) -> Plane | None:
    """The plane with most points (N, 3) around a sensor, below or above it in its own frame; None
    where none has enough."""
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    side = (xyz[:, 2] < 0.0) if below else (xyz[:, 2] > 0.0)
    candidate = side & (distance > NEAREST) & (distance < MAX_REACH)
    if candidate.sum() < MIN_POINTS:
        return None
    plane = fit_plane_by_ransac(_evened(xyz[candidate]), STEEP)
    if plane is None or (plane[2] > -MIN_HEIGHT if below else plane[2] < MIN_HEIGHT):
        return None
    # What is near says most of how the robot stands: roads fall to their curbs.
    near = candidate & (np.abs(height_above_plane(xyz, plane)) <= STEEP.inlier_distance)
    if near.sum() < MIN_POINTS:
        return None
    reach = np.clip(REACH * np.percentile(distance[near], 2), MIN_REACH, MAX_REACH)
    around = candidate & (distance < reach)
    for _ in range(10):
        on = around & (np.abs(height_above_plane(xyz, plane)) <= CLOSE)
        fitted = _evenly_fitted(xyz[on])
        if fitted is None:
            return None
        moved, plane = np.abs(fitted - plane).max(), fitted
        if moved < 1e-5:
            break
    off = height_above_plane(xyz, plane)
    on = around & (np.abs(off) <= CLOSE)
    beyond = around & ((off < -DEEP) if below else (off > DEEP))  # under a table, not the ground
    share = on.sum() / max(1, (around & ((off if below else -off) < 1.0)).sum())
    if on.sum() < MIN_POINTS or share < MIN_SHARE or (
            beyond.sum() > MAX_BEYOND * on.sum()) or (
            np.percentile(distance[on], 90) < MIN_EXTENT):
        return None
    error = _error(xyz[on])
    normal = _normal(plane, below)
    return Plane(normal, float(abs(plane[2]) * abs(normal[2])), error, on)


def _normal(plane: np.ndarray, below: bool) -> np.ndarray:
    normal = np.array([-plane[0], -plane[1], 1.0]) / np.sqrt(plane[0]**2 + plane[1]**2 + 1.0)
    return normal if below else -normal


def _evened(xyz: np.ndarray, cell: float = 0.25) -> np.ndarray:
    """One point of each cell: beams draw many points where the ground is near."""
    _, first = np.unique(np.floor(xyz / cell).astype(np.int64) @ [1 << 40, 1 << 20, 1],
                         return_index=True)
    return xyz[np.sort(first)]


def _evenly_fitted(xyz: np.ndarray) -> np.ndarray | None:
    """The plane through points (n, 3), of which those of a cell count together: beams draw many
    where the ground is near."""
    if len(xyz) < 3:
        return None
    cells = np.floor(xyz[:, :2] / 0.5).astype(np.int64) @ [1 << 20, 1]
    _, which, count = np.unique(cells, return_inverse=True, return_counts=True)
    mean = np.column_stack([np.bincount(which, xyz[:, k]) / count for k in range(3)])
    return fit_plane(mean)


def _error(xyz: np.ndarray) -> np.ndarray:
    """(3,) of height, roll and pitch: from fits that leave out one sector each (jackknife)."""
    sector = np.empty(len(xyz), np.int64)
    sector[np.argsort(np.arctan2(xyz[:, 1], xyz[:, 0]))] = np.arange(len(xyz)) * SECTORS // len(xyz)
    found = []
    for k in range(SECTORS):
        plane = _evenly_fitted(xyz[sector != k])
        if plane is not None:
            found.append([plane[2], np.arctan(plane[1]), np.arctan(plane[0])])
    if len(found) < 3:
        return np.array([np.inf] * 3)
    n = len(found)
    return np.sqrt((n - 1) / n * ((np.array(found) - np.mean(found, axis=0)) ** 2).sum(axis=0))


def on_the_ground(scans: Sequence[Scan]) -> bool:
    """Whether most scans lie on a level plane through their origin, as clouds in base_footprint: on
    one LOWERED below it once they are."""
    planes = [ground_plane(scan.xyz - [0.0, 0.0, LOWERED], True) for scan in scans]
    return 2 * sum(p is not None and abs(p.height - LOWERED) < MIN_HEIGHT
                   for p in planes) > len(planes)


def _points(planes: Sequence[Plane | None]) -> float:
    """How many points planes have, the median."""
    return float(np.median([p.on.sum() for p in planes if p is not None] or [0]))


def mount_of(scans: Sequence[Scan]) -> Mount | None:
    """Height, roll and pitch over the ground; None where fewer than half of the scans show ground.
    The plane below counts, the one overhead only where it is found in twice as many scans, or has
    by far more points than what may be a slice of a wall."""
    below, above = ([ground_plane(scan.xyz, down) for scan in scans] for down in (True, False))
    under, over = (sum(p is not None for p in planes) for planes in (below, above))
    upside_down = over > 2 * under or (
        over >= under and _points(above) > MUCH_MORE * _points(below))
    planes = above if upside_down else below
    found = [p for p in planes if p is not None]
    if len(found) * 2 < len(scans) or not found:
        return None
    rows = np.array([[p.height, np.unwrap([np.pi if upside_down else 0.0, p.roll])[1], p.pitch]
                     for p in found])
    middle = np.median(rows, axis=0)
    spread = 1.4826 * np.median(np.abs(rows - middle), axis=0)
    own = np.median([p.error for p in found], axis=0)
    # One place is measured as exactly as a scan says; many places as they agree.
    error = np.maximum(1.2533 * spread / np.sqrt(len(found)), own / np.sqrt(len(found)))
    roll = (middle[1] + np.pi) % (2 * np.pi) - np.pi
    return Mount(float(middle[0]), float(roll), float(middle[2]), error, spread, list(planes),
                 upside_down)
