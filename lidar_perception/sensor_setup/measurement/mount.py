"""Height of the sensor above the ground, and its roll and pitch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lidar_perception.data.mount_check import MAX_LEAN_DEG
from lidar_perception.ground.params import ThresholdParams
from lidar_perception.ground.threshold import fit_plane, fit_plane_by_ransac, height_above_plane
from lidar_perception.robot.placement import make_tilted_pose
from lidar_perception.sensor_setup.measurement.scans import Scan

# Maximum tilt of a sensor against the ground; if larger, the frame is a different one.
STEEP = ThresholdParams(max_slope=45.0, inlier_distance=0.08)
MIN_DISTANCE_M = 0.3  # minimum distance of ground points, outside the robot
REACH_RATIO = 2.5  # ground is fitted up to this many times the distance of its nearest
MIN_REACH_M, MAX_REACH_M = 5.0, 25.0  # part, within these limits
MIN_SHARE = 0.12  # minimum fraction of the low points that are on the plane
MIN_POINTS = 60
INLIER_DISTANCE_M = 0.05  # inlier distance of the final plane fit
# Depth of points below the plane, and their maximum fraction relative to those on it.
MIN_DEPTH_M, MAX_BEYOND_SHARE = 0.3, 0.25
SECTORS = 6  # sectors of a scan, each left out once to estimate the error
MIN_HEIGHT_M = 0.1  # a closer surface is what the sensor stands on
UPSIDE_DOWN_RATIO = 8.0  # ratio of points above to below from which the surface above is the floor
MIN_EXTENT_M = 1.5  # minimum extent of the plane
LOWERED_M = 1.0  # clouds are lowered by this to find a floor at their origin


class Plane(NamedTuple):
    """The ground in the sensor's frame.

    Attributes:
        normal: (3,) unit vector that points up.
        height: Height of the sensor above it, m.
        error: (3,) errors of height (m), roll and pitch (rad), from leaving out sectors.
        on: (N,) bool, the points on it.
    """

    normal: np.ndarray
    height: float
    error: np.ndarray
    on: np.ndarray

    @property
    def roll(self) -> float:
        """Roll in rad, as in a URDF's rpy."""
        return float(np.arctan2(self.normal[1], self.normal[2]))

    @property
    def pitch(self) -> float:
        """Pitch in rad, as in a URDF's rpy; positive looks down."""
        return float(-np.arcsin(np.clip(self.normal[0], -1.0, 1.0)))


class Mount(NamedTuple):
    """Pose of the sensor over the ground, the median over the scans.

    Attributes:
        height: Metres.
        roll, pitch: Radians.
        error: (3,) standard errors of the medians of height, roll and pitch.
        spread: (3,) robust standard deviations from scan to scan.
        planes: Ground of each scan, None if none was found.
        upside_down: The ground is in the direction of the sensor's z axis.
    """

    height: float
    roll: float
    pitch: float
    error: np.ndarray
    spread: np.ndarray
    planes: list[Plane | None]
    upside_down: bool

    @property
    def pose(self) -> np.ndarray:
        """(4, 4) transform from the sensor to a level frame on the ground below it."""
        return make_tilted_pose(self.roll, self.pitch, self.height)

    @property
    def normal(self) -> np.ndarray:
        """(3,) unit vector in the sensor's frame that points up."""
        return self.pose[2, :3]

    @property
    def is_level(self) -> bool:
        """True if the sensor's z axis points up, within the slope of roads."""
        return bool(self.normal[2] >= np.cos(np.radians(MAX_LEAN_DEG)))


def find_ground_plane(xyz: np.ndarray, below: bool) -> Plane | None:
    """Find the plane with most points around a sensor.

    Args:
        xyz: (N, 3) points in the sensor's frame.
        below: Search below the sensor, else above it, in its own frame.

    Returns:
        The plane; None if none has enough points.
    """
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    side = (xyz[:, 2] < 0.0) if below else (xyz[:, 2] > 0.0)
    candidate = side & (distance > MIN_DISTANCE_M) & (distance < MAX_REACH_M)
    if candidate.sum() < MIN_POINTS:
        return None
    plane = fit_plane_by_ransac(_thin_by_cells(xyz[candidate]), STEEP)
    if plane is None or (plane[2] > -MIN_HEIGHT_M if below else plane[2] < MIN_HEIGHT_M):
        return None
    # Near ground best shows how the robot stands, since roads slope towards their curbs.
    near = candidate & (np.abs(height_above_plane(xyz, plane)) <= STEEP.inlier_distance)
    if near.sum() < MIN_POINTS:
        return None
    reach = np.clip(REACH_RATIO * np.percentile(distance[near], 2), MIN_REACH_M, MAX_REACH_M)
    around = candidate & (distance < reach)
    for _ in range(10):
        on = around & (np.abs(height_above_plane(xyz, plane)) <= INLIER_DISTANCE_M)
        fitted = _fit_cell_means(xyz[on])
        if fitted is None:
            return None
        moved, plane = np.abs(fitted - plane).max(), fitted
        if moved < 1e-5:
            break
    off = height_above_plane(xyz, plane)
    on = around & (np.abs(off) <= INLIER_DISTANCE_M)
    beyond = around & ((off < -MIN_DEPTH_M) if below else (off > MIN_DEPTH_M))  # the sensor may be below a table
    share = on.sum() / max(1, (around & ((off if below else -off) < 1.0)).sum())
    if (
        on.sum() < MIN_POINTS
        or share < MIN_SHARE
        or (beyond.sum() > MAX_BEYOND_SHARE * on.sum())
        or (np.percentile(distance[on], 90) < MIN_EXTENT_M)
    ):
        return None
    error = _estimate_error(xyz[on])
    normal = _compute_normal(plane, below)
    return Plane(normal, float(abs(plane[2]) * abs(normal[2])), error, on)


def _compute_normal(plane: np.ndarray, below: bool) -> np.ndarray:
    normal = np.array([-plane[0], -plane[1], 1.0]) / np.sqrt(plane[0] ** 2 + plane[1] ** 2 + 1.0)
    return normal if below else -normal


def _thin_by_cells(xyz: np.ndarray, cell: float = 0.25) -> np.ndarray:
    """Return one point of each cell, since near ground has many points."""
    _, first = np.unique(np.floor(xyz / cell).astype(np.int64) @ [1 << 40, 1 << 20, 1], return_index=True)
    return xyz[np.sort(first)]


def _fit_cell_means(xyz: np.ndarray) -> np.ndarray | None:
    """Fit a plane to the means of points (N, 3) in cells, since near ground has many points."""
    if len(xyz) < 3:
        return None
    cells = np.floor(xyz[:, :2] / 0.5).astype(np.int64) @ [1 << 20, 1]
    _, which, count = np.unique(cells, return_inverse=True, return_counts=True)
    mean = np.column_stack([np.bincount(which, xyz[:, k]) / count for k in range(3)])
    return fit_plane(mean)


def _estimate_error(xyz: np.ndarray) -> np.ndarray:
    """Return errors (3,) of height, roll and pitch, from fits without one sector (jackknife)."""
    sector = np.empty(len(xyz), np.int64)
    sector[np.argsort(np.arctan2(xyz[:, 1], xyz[:, 0]))] = np.arange(len(xyz)) * SECTORS // len(xyz)
    found = []
    for k in range(SECTORS):
        plane = _fit_cell_means(xyz[sector != k])
        if plane is not None:
            found.append([plane[2], np.arctan(plane[1]), np.arctan(plane[0])])
    if len(found) < 3:
        return np.array([np.inf] * 3)
    n = len(found)
    return np.sqrt((n - 1) / n * ((np.array(found) - np.mean(found, axis=0)) ** 2).sum(axis=0))


def is_on_ground(scans: Sequence[Scan]) -> bool:
    """Return True if the ground contains the origin of most scans, as in base_footprint."""
    planes = [find_ground_plane(scan.xyz - [0.0, 0.0, LOWERED_M], True) for scan in scans]
    return 2 * sum(p is not None and abs(p.height - LOWERED_M) < MIN_HEIGHT_M for p in planes) > len(planes)


def _median_points(planes: Sequence[Plane | None]) -> float:
    """Return the median number of points of the planes."""
    return float(np.median([p.on.sum() for p in planes if p is not None] or [0]))


def measure_mount(scans: Sequence[Scan]) -> Mount | None:
    """Measure height, roll and pitch over the ground.

    The plane below the sensor counts. The plane overhead counts only if it is found in twice as
    many scans, or has far more points than one below, which may be a slice of a wall.

    Returns:
        The mount; None if fewer than half of the scans show ground.
    """
    below, above = ([find_ground_plane(scan.xyz, down) for scan in scans] for down in (True, False))
    under, over = (sum(p is not None for p in planes) for planes in (below, above))
    upside_down = over > 2 * under or (
        over >= under and _median_points(above) > UPSIDE_DOWN_RATIO * _median_points(below)
    )
    planes = above if upside_down else below
    found = [p for p in planes if p is not None]
    if len(found) * 2 < len(scans) or not found:
        return None
    rows = np.array([[p.height, np.unwrap([np.pi if upside_down else 0.0, p.roll])[1], p.pitch] for p in found])
    middle = np.median(rows, axis=0)
    spread = 1.4826 * np.median(np.abs(rows - middle), axis=0)
    own = np.median([p.error for p in found], axis=0)
    # For one place, use the error of a scan; for many, use the spread between them.
    error = np.maximum(1.2533 * spread / np.sqrt(len(found)), own / np.sqrt(len(found)))
    roll = (middle[1] + np.pi) % (2 * np.pi) - np.pi
    return Mount(float(middle[0]), float(roll), float(middle[2]), error, spread, list(planes), upside_down)
