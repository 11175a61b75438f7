"""Ego motion: sources of the sensor's poses, validity checks, and extrapolation of missing poses.

A pose is a (4, 4) float64 matrix that transforms from the sensor's frame to a fixed frame. Without
poses, the sensor's frame is used as fixed frame, and velocities are relative to the sensor.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from lidar_perception.data.frame import Frame
from lidar_perception.types import InputError

MAX_SPEED = 100.0  # maximum speed of the sensor in m/s; a faster pose change is a jump
MAX_ROTATION_ERROR = 1e-2  # maximum element of R R^T - I in a valid pose
SOURCES = ("recording", "odometry", "tf", "kiss_icp")  # sources of poses, best first
NO_SOURCE = "none"
MAP_CELL, FINE_CELL, COARSE_CELL = 0.5, 1.5, 3.0  # cell sizes of KISS-ICP's downsampling, in map voxels
MIN_COARSE_POINTS = 300  # minimum number of points to register a scan at the coarse resolution
CONVERGENCE = 1e-3  # step in m and rad below which KISS-ICP stops


@dataclass(frozen=True)
class Ego:
    """Motion state of the sensor.

    Attributes:
        pose: (4, 4) current pose, extrapolated if no pose was measured.
        velocity: (3,) m/s in the sensor's frame, from the last two measured poses.
        rotation: (3,) angular velocity as a rotation vector, rad/s, from the same two poses.
        missing_s: Time since the last measured pose, in seconds.
        has_pose: True after the first measured pose.
    """

    pose: np.ndarray
    velocity: np.ndarray
    rotation: np.ndarray
    missing_s: float = 0.0
    has_pose: bool = False

    @staticmethod
    def unknown() -> Ego:
        """Return the state before the first pose."""
        return Ego(np.eye(4), np.zeros(3), np.zeros(3))


def is_valid_pose(pose: np.ndarray | None) -> bool:
    """Return True if a pose is a finite, rigid (4, 4) transform."""
    if pose is None or np.shape(pose) != (4, 4) or not np.isfinite(pose).all():
        return False
    rotation = np.asarray(pose, float)[:3, :3]
    return bool(np.abs(rotation @ rotation.T - np.eye(3)).max() < MAX_ROTATION_ERROR and np.linalg.det(rotation) > 0)


def advance_ego(ego: Ego, pose: np.ndarray | None, seconds: float, max_gap: float) -> Ego:
    """Return the motion state `seconds` later, given the pose measured at that time.

    If the pose is missing (None), the sensor is assumed to keep its velocity until max_gap seconds
    after the last measured pose, and then to stop.
    """
    if pose is not None:
        pose = np.asarray(pose, np.float64)
        elapsed_s = seconds + ego.missing_s
        if not ego.has_pose or elapsed_s <= 0:
            return Ego(pose, ego.velocity, ego.rotation, 0.0, True)
        measured_pose = ego.pose @ np.linalg.inv(_compute_step(ego, min(ego.missing_s, max_gap)))
        step = np.linalg.inv(measured_pose) @ pose
        return Ego(pose, step[:3, 3] / elapsed_s, Rotation.from_matrix(step[:3, :3]).as_rotvec() / elapsed_s, 0.0, True)
    motion_s = max(min(seconds, max_gap - ego.missing_s), 0.0)
    return Ego(
        ego.pose @ _compute_step(ego, motion_s), ego.velocity, ego.rotation, ego.missing_s + seconds, ego.has_pose
    )


def _compute_step(ego: Ego, seconds: float) -> np.ndarray:
    step = np.eye(4)
    step[:3, :3] = Rotation.from_rotvec(ego.rotation * seconds).as_matrix()
    step[:3, 3] = ego.velocity * seconds
    return step


def is_jump(ego: Ego, pose: np.ndarray, seconds: float) -> bool:
    """Return True if the distance to the last pose is too large for the elapsed time."""
    distance = np.linalg.norm(np.asarray(pose, float)[:3, 3] - ego.pose[:3, 3])
    return ego.has_pose and bool(distance > MAX_SPEED * (seconds + ego.missing_s) + 1.0)


def choose_source(requested: str, available: Collection[str]) -> str:
    """Choose the requested source of poses, or with "auto" the best available one.

    Returns NO_SOURCE if the requested source is not available.
    """
    return next((name for name in SOURCES if name in available and requested in ("auto", name)), NO_SOURCE)


def choose_recorded_source(has_poses: bool) -> str:
    """Choose the best available source of poses for a recording, which may contain poses itself."""
    return choose_source("auto", [*["recording"] * has_poses, *["kiss_icp"] * has_odometry()])


def make_pose_reader(source: str) -> Callable[[Frame], np.ndarray | None]:
    """Return a function that maps a frame to its pose (4, 4), or to None if it has no pose.

    Call the function for the frames of a drive in order. With KISS-ICP, it loads each frame.

    Raises:
        InputError: The source is kiss_icp, which is not installed.
    """
    if source == "kiss_icp":
        odometry = Odometry()
        return lambda frame: odometry(frame.load().xyz)
    return lambda frame: frame.pose() if source == "recording" else None


def has_odometry() -> bool:
    """Return True if KISS-ICP (the extra [odometry]) is installed."""
    return importlib.util.find_spec("kiss_icp") is not None


class Odometry:
    """KISS-ICP odometry (Vizzo et al., RA-L 2023): odometry(xyz) -> pose.

    It runs in one thread, so that the same scans always give the same poses. Scans are registered
    at the coarse resolution if that leaves MIN_COARSE_POINTS points, otherwise at the fine one.

    Raises:
        InputError: kiss-icp is not installed.
    """

    def __init__(self, voxel: float = 1.0) -> None:
        try:
            from kiss_icp.config.parser import KISSConfig
            from kiss_icp.kiss_icp import KissICP
            from kiss_icp.voxelization import voxel_down_sample
        except ImportError:
            raise InputError(
                "kiss-icp, which estimates ego motion from scans, is not installed; run "
                "pip install 'lidar_perception[odometry]'"
            ) from None
        config = KISSConfig()
        config.mapping.voxel_size, config.data.deskew = voxel, False
        config.registration.max_num_threads = 1
        config.registration.convergence_criterion = CONVERGENCE

        def voxelize(scan: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            """Return the points for registration, and the points for the map."""
            map_points = voxel_down_sample(scan, MAP_CELL * voxel)
            coarse_points = voxel_down_sample(map_points, COARSE_CELL * voxel)
            if len(coarse_points) >= MIN_COARSE_POINTS:
                return coarse_points, map_points
            return voxel_down_sample(map_points, FINE_CELL * voxel), map_points

        self._icp = KissICP(config)
        self._icp.voxelize = voxelize

    def __call__(self, xyz: np.ndarray) -> np.ndarray:
        """Return the pose (4, 4) of the next scan (N, 3) in the frame of the first scan."""
        self._icp.register_frame(np.asarray(xyz, np.float64), np.zeros(0))
        return np.array(self._icp.last_pose)
