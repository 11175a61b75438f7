"""Check of the height and tilt of a sensor, which are measured from the ground in its clouds."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice

import numpy as np

from lidar_perception.data.frame import Recording
from lidar_perception.ground.params import SensorPoseParams, ThresholdParams
from lidar_perception.ground.segment import level_points
from lidar_perception.ground.threshold import compute_height_above_plane, fit_plane_by_ransac
from lidar_perception.types import SENSOR_HEIGHT, InputError, PointCloud

# Range of points that are used to fit the floor: beyond the vehicle, and close enough for one plane.
MIN_RANGE_M, MAX_RANGE_M = 2.5, 12.0
CELL_M = 0.5  # cell size of the grid; the lowest point of each cell is used
FLOOR_PLANE = ThresholdParams(max_slope=10.0)  # settings of the plane fit
STEEP_FLOOR_PLANE = ThresholdParams(max_slope=30.0)  # settings of the plane fit for a tilted sensor
MIN_CELLS = 10  # minimum number of cells with points to fit a plane
MIN_FLOOR_FRACTION = 0.25  # minimum fraction of cells whose lowest point is on the plane
# A plane above the sensor is the floor of an inverted sensor if at most MAX_BEYOND_FRACTION of the points are more
# than MIN_BEYOND_M above it; otherwise it may be a ceiling or foliage.
MAX_BEYOND_FRACTION = 0.33
MIN_BEYOND_M = 0.3
FIRST_CLOUDS = 3  # number of clouds to check at the start of a recording
HEIGHT_TOLERANCE_M = 0.25  # tolerance between the parameter and the measured height
MAX_TILT_DEG = 5.0  # maximum measured tilt that the slope of a road can explain


def measure_sensor_height(xyz: np.ndarray, pose: SensorPoseParams = SensorPoseParams()) -> float | None:
    """Measure the height of the sensor above the ground around it, in metres.

    The ground is the plane through most of the lowest points in the cells of a grid, so that dense
    walls or vehicles do not outweigh it. The height is negative if the plane is overhead, which
    happens if the sensor is upside down. Returns None if no such plane is found.
    """
    plane = _find_floor(level_points(xyz, pose))
    return None if plane is None else -float(plane[2])


def find_height_problem(measured_height: float | None, pose: SensorPoseParams) -> str | None:
    """Describe a wrong height in sensor_pose, with the remedy; None if it matches the measured height."""
    if measured_height is None or abs(measured_height - pose.height) <= HEIGHT_TOLERANCE_M:
        return None
    if measured_height < 0:
        return (
            f"the ground seems to be {-measured_height:.2f} m above the sensor; if it is mounted "
            "upside down, set ground.sensor_pose.roll to 3.1416"
        )
    return (
        f"the sensor is {measured_height:.2f} m above the ground but ground.sensor_pose.height is "
        f"{pose.height:g}; set it to {measured_height:.2f}"
    )


def load_first_clouds(recording: Recording) -> list[PointCloud]:
    """Load the first clouds of a recording for the checks; return [] if one of them cannot be read."""
    try:
        return [frame.load() for frame in islice(recording, FIRST_CLOUDS)]
    except InputError:
        return []


def apply_measured_height(recording: Recording, clouds: Sequence[PointCloud]) -> Recording:
    """Reopen a recording with the sensor height that is measured in its first clouds.

    The recording is returned unchanged if it states the height, if the heights measured in its
    clouds differ, or if the measured height is close to that of KITTI's sensor.
    """
    if recording.has_sensor_height or recording.reopen is None:
        return recording
    heights = -_find_floors(clouds)[:, 2]
    if not len(heights) or np.ptp(heights) > HEIGHT_TOLERANCE_M:
        return recording
    height = round(float(np.median(heights)), 2)
    if height < 0 or abs(height - SENSOR_HEIGHT) <= HEIGHT_TOLERANCE_M:
        return recording
    return recording.reopen(sensor_height=height)


def find_mount_problem(recording: Recording, clouds: Sequence[PointCloud]) -> str | None:
    """Describe a tilted or inverted sensor in the first clouds, with the remedy.

    Returns None if the sensor is level, or if a floor is found in fewer than two clouds.
    """
    floors = _find_floors(clouds, STEEP_FLOOR_PLANE)
    if len(floors) < 2:
        return None
    height = -float(np.median(floors[:, 2]))
    tilt = float(np.median(np.degrees(np.arctan(np.hypot(*floors[:, :2].T)))))
    if height >= 0 and tilt <= MAX_TILT_DEG:
        return None
    finding = (
        f"the sensor is tilted by {tilt:.0f} degrees against the ground"
        if height >= 0
        else f"the ground seems to be {-height:.2f} m above the sensor, so the sensor is mounted upside down"
    )
    return (
        f"{finding}, but detectors expect z to point up; measure the mounting with setup, and make a level bag "
        f"with convert {recording.path} --robot robot/robot.param.yaml --out level.bag"
    )


def _find_floor(xyz: np.ndarray, params: ThresholdParams = FLOOR_PLANE) -> np.ndarray | None:
    """Return the plane z = a x + b y + c, (3,), of the ground in points (N, 3)."""
    squared_range = np.einsum("ij,ij->i", xyz[:, :2], xyz[:, :2])
    nearby_points = xyz.compress((squared_range >= MIN_RANGE_M**2) & (squared_range <= MAX_RANGE_M**2), axis=0)
    lowest = _find_lowest_points(nearby_points)
    if len(lowest) < MIN_CELLS:
        return None
    plane = fit_plane_by_ransac(lowest, params)
    if plane is None:
        return None
    if plane[2] > 0 and (compute_height_above_plane(nearby_points, plane) > MIN_BEYOND_M).mean() > MAX_BEYOND_FRACTION:
        return None
    on_plane = np.abs(compute_height_above_plane(lowest, plane)) <= params.inlier_distance
    return plane if on_plane.mean() >= MIN_FLOOR_FRACTION else None


def _find_lowest_points(nearby_points: np.ndarray) -> np.ndarray:
    """Return the lowest point of each grid cell, (K, 3)."""
    side = 2 * round(MAX_RANGE_M / CELL_M) + 1
    column, row = np.floor((nearby_points[:, :2] + MAX_RANGE_M) / CELL_M).astype(np.int64).T
    cells = row * side + column
    min_z = np.full(side * side, np.inf, nearby_points.dtype)
    np.minimum.at(min_z, cells, nearby_points[:, 2])
    lowest = np.flatnonzero(nearby_points[:, 2] == min_z[cells])
    return nearby_points[lowest[np.unique(cells[lowest], return_index=True)[1]]]


def _find_floors(clouds: Sequence[PointCloud], params: ThresholdParams = FLOOR_PLANE) -> np.ndarray:
    """Return the planes (K, 3) of the floors in those clouds that have one."""
    return np.array(
        [plane for cloud in clouds if len(cloud) if (plane := _find_floor(cloud.xyz, params)) is not None]
    ).reshape(-1, 3)
