"""Height of the sensor above the ground, and its roll and pitch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lidar_perception.data.mount_check import MAX_TILT_DEG
from lidar_perception.ground.params import ThresholdParams
from lidar_perception.ground.threshold import compute_height_above_plane, fit_plane, fit_plane_by_ransac
from lidar_perception.robot.placement import make_tilted_pose
from lidar_perception.sensor_setup.measurement.scans import Scan

TILTED_GROUND = ThresholdParams(max_slope=45.0, inlier_distance=0.08)  # for sensors with a tilt of up to 45 degrees
MIN_DISTANCE_M = 0.3  # minimum distance of ground points, outside the robot
RADIUS_RATIO = 2.5  # radius of the plane fit, relative to the distance of the nearest ground
MIN_RADIUS_M, MAX_RADIUS_M = 5.0, 25.0
MIN_INLIER_FRACTION = 0.12  # minimum fraction of the low points that are on the plane
MIN_POINTS = 60  # minimum number of ground points
INLIER_DISTANCE_M = 0.05  # inlier distance of the final plane fit
# Depth of points below the plane, and their maximum number relative to the inliers.
MIN_DEPTH_M, MAX_BELOW_RATIO = 0.3, 0.25
SECTORS = 6  # number of sectors for the jackknife estimate of the error
MIN_HEIGHT_M = 0.1  # minimum height of the sensor; closer surfaces belong to its support
# Minimum ratio of points on the upper plane to points on the lower one if the sensor is upside down.
UPSIDE_DOWN_RATIO = 8.0
MIN_EXTENT_M = 1.5  # minimum extent of the plane
OFFSET_M = 1.0  # distance by which clouds are lowered to find a floor at their origin
CELL_M, MEAN_CELL_M = 0.25, 0.5  # cell sizes of the subsampling for RANSAC, and of the means for the final fit


class Plane(NamedTuple):
    """Ground plane in the sensor's frame.

    Attributes:
        normal: (3,) unit vector that points up.
        height: Height of the sensor above the plane, m.
        error: (3,) standard errors of height (m), roll and pitch (rad), by jackknife over sectors.
        inliers: (N,) bool, points on the plane.
    """

    normal: np.ndarray
    height: float
    error: np.ndarray
    inliers: np.ndarray

    @property
    def roll(self) -> float:
        """Roll in rad, as in a URDF's rpy."""
        return float(np.arctan2(self.normal[1], self.normal[2]))

    @property
    def pitch(self) -> float:
        """Pitch in rad, as in a URDF's rpy; positive if the sensor points down."""
        return float(-np.arcsin(np.clip(self.normal[0], -1.0, 1.0)))


class Mount(NamedTuple):
    """Pose of the sensor above the ground, the median over the scans.

    Attributes:
        height: Metres.
        roll, pitch: Radians.
        error: (3,) standard errors of the medians of height, roll and pitch.
        spread: (3,) robust standard deviations of height, roll and pitch between scans.
        planes: Ground plane of each scan, None if none was found.
        upside_down: True if the sensor's z axis points to the ground.
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
        """True if the sensor's z axis points up, within MAX_TILT_DEG (the slope of roads)."""
        return bool(self.normal[2] >= np.cos(np.radians(MAX_TILT_DEG)))


def find_ground_plane(xyz: np.ndarray, below: bool) -> Plane | None:
    """Find the ground plane around a sensor.

    Args:
        xyz: (N, 3) points in the sensor's frame.
        below: True to search at z < 0, False to search at z > 0, for sensors mounted upside down.

    Returns:
        The plane; None if no plane has enough points.
    """
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    on_side = (xyz[:, 2] < 0.0) if below else (xyz[:, 2] > 0.0)
    is_candidate = on_side & (distance > MIN_DISTANCE_M) & (distance < MAX_RADIUS_M)
    if is_candidate.sum() < MIN_POINTS:
        return None
    plane = fit_plane_by_ransac(_keep_one_per_cell(xyz[is_candidate]), TILTED_GROUND)
    if plane is None or (plane[2] > -MIN_HEIGHT_M if below else plane[2] < MIN_HEIGHT_M):
        return None
    # Only the ground near the sensor is used, because roads slope towards their curbs.
    is_ground = is_candidate & (np.abs(compute_height_above_plane(xyz, plane)) <= TILTED_GROUND.inlier_distance)
    if is_ground.sum() < MIN_POINTS:
        return None
    radius = np.clip(RADIUS_RATIO * np.percentile(distance[is_ground], 2), MIN_RADIUS_M, MAX_RADIUS_M)
    is_near = is_candidate & (distance < radius)
    for _ in range(10):
        is_inlier = is_near & (np.abs(compute_height_above_plane(xyz, plane)) <= INLIER_DISTANCE_M)
        new_plane = _fit_cell_means(xyz[is_inlier])
        if new_plane is None:
            return None
        change, plane = np.abs(new_plane - plane).max(), new_plane
        if change < 1e-5:
            break
    height = compute_height_above_plane(xyz, plane) if below else -compute_height_above_plane(xyz, plane)
    is_inlier = is_near & (np.abs(height) <= INLIER_DISTANCE_M)
    count = is_inlier.sum()
    if (
        count < MIN_POINTS
        or count < MIN_INLIER_FRACTION * max(1, (is_near & (height < 1.0)).sum())
        or (is_near & (height < -MIN_DEPTH_M)).sum() > MAX_BELOW_RATIO * count  # the plane is a table
        or np.percentile(distance[is_inlier], 90) < MIN_EXTENT_M
    ):
        return None
    normal = _compute_normal(plane, below)
    return Plane(normal, float(abs(plane[2]) * abs(normal[2])), _estimate_error(xyz[is_inlier]), is_inlier)


def _compute_normal(plane: np.ndarray, below: bool) -> np.ndarray:
    normal = np.array([-plane[0], -plane[1], 1.0]) / np.sqrt(plane[0] ** 2 + plane[1] ** 2 + 1.0)
    return normal if below else -normal


def _keep_one_per_cell(xyz: np.ndarray) -> np.ndarray:
    """Subsample points (N, 3) to one per cell, so that the dense ground near the sensor does not dominate."""
    _, indices = np.unique(np.floor(xyz / CELL_M).astype(np.int64) @ [1 << 40, 1 << 20, 1], return_index=True)
    return xyz[np.sort(indices)]


def _fit_cell_means(xyz: np.ndarray) -> np.ndarray | None:
    """Fit a plane to the mean point of each cell, so that the dense ground near the sensor does not dominate."""
    if len(xyz) < 3:
        return None
    cells = np.floor(xyz[:, :2] / MEAN_CELL_M).astype(np.int64) @ [1 << 20, 1]
    _, cell_index, count = np.unique(cells, return_inverse=True, return_counts=True)
    mean = np.column_stack([np.bincount(cell_index, xyz[:, k]) / count for k in range(3)])
    return fit_plane(mean)


def _estimate_error(xyz: np.ndarray) -> np.ndarray:
    """Estimate standard errors (3,) of height, roll and pitch by a jackknife over sectors."""
    sector = np.empty(len(xyz), np.int64)
    sector[np.argsort(np.arctan2(xyz[:, 1], xyz[:, 0]))] = np.arange(len(xyz)) * SECTORS // len(xyz)
    planes = [_fit_cell_means(xyz[sector != k]) for k in range(SECTORS)]
    fits = np.array([[p[2], np.arctan(p[1]), np.arctan(p[0])] for p in planes if p is not None])
    n = len(fits)
    return np.full(3, np.inf) if n < 3 else np.sqrt((n - 1) / n * ((fits - fits.mean(axis=0)) ** 2).sum(axis=0))


def is_on_ground(scans: Sequence[Scan]) -> bool:
    """Return True if the origin of most scans is on the ground, as in base_footprint."""
    planes = [find_ground_plane(scan.xyz - [0.0, 0.0, OFFSET_M], below=True) for scan in scans]
    return 2 * sum(p is not None and abs(p.height - OFFSET_M) < MIN_HEIGHT_M for p in planes) > len(planes)


def _median_inlier_count(planes: Sequence[Plane | None]) -> float:
    return float(np.median([p.inliers.sum() for p in planes if p is not None] or [0]))


def measure_mount(scans: Sequence[Scan]) -> Mount | None:
    """Measure height, roll and pitch of the sensor above the ground.

    The sensor is upside down if a plane above is found in more than twice as many scans as a plane
    below, or if the plane above has far more points. The plane below may be a slice of a wall.

    Returns:
        The mount; None if fewer than half of the scans show ground.
    """
    below, above = ([find_ground_plane(scan.xyz, below) for scan in scans] for below in (True, False))
    below_count, above_count = (sum(p is not None for p in planes) for planes in (below, above))
    upside_down = above_count > 2 * below_count or (
        above_count >= below_count and _median_inlier_count(above) > UPSIDE_DOWN_RATIO * _median_inlier_count(below)
    )
    planes = above if upside_down else below
    valid_planes = [p for p in planes if p is not None]
    if len(valid_planes) * 2 < len(scans) or not valid_planes:
        return None
    rows = np.array([[p.height, np.unwrap([np.pi if upside_down else 0.0, p.roll])[1], p.pitch] for p in valid_planes])
    median = np.median(rows, axis=0)
    spread = 1.4826 * np.median(np.abs(rows - median), axis=0)
    scan_error = np.median([p.error for p in valid_planes], axis=0)
    # The spread between scans underestimates the error if all scans are from one place.
    error = np.maximum(1.2533 * spread / np.sqrt(len(valid_planes)), scan_error / np.sqrt(len(valid_planes)))
    roll = (median[1] + np.pi) % (2 * np.pi) - np.pi
    return Mount(float(median[0]), float(roll), float(median[2]), error, spread, list(planes), upside_down)
