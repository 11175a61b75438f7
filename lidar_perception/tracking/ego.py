"""The sensor's own motion: boxes into a fixed frame and back, and poses where some are missing.

A pose (4, 4) float64 is the sensor's frame in a fixed one. Without poses the fixed frame is the
sensor's own, and velocities are relative to it.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from lidar_perception.data.frame import Frame
from lidar_perception.types import InputError

MAX_SPEED = 100.0   # m/s; a sensor that seems faster was put somewhere else
NOT_RIGID = 1e-2    # how far a pose's rotation may be from one
SOURCES = ("recording", "odometry", "tf", "kiss_icp")  # of poses, the best first
NO_SOURCE = "none"
MAPPED, FINE = 0.5, 1.5  # of a voxel of the map: one point in each goes there, is registered
COARSE, ENOUGH = 3.0, 300
CONVERGED = 1e-3    # m and rad, the step of KISS-ICP that is its last


@dataclass(frozen=True)
class Ego:
    """pose (4, 4); velocity (3,) m/s in the sensor's frame and rotation (3,) rad/s, as a vector,
    as of the last two poses that were given; missing: seconds since the last one; known: whether
    there ever was one."""

    pose: np.ndarray
    velocity: np.ndarray
    rotation: np.ndarray
    missing: float = 0.0
    known: bool = False

    @staticmethod
    def unknown() -> Ego:
        """Before any pose."""
        return Ego(np.eye(4), np.zeros(3), np.zeros(3))


def usable(pose: np.ndarray | None) -> bool:
    """Whether this is a pose: rigid, and all of it finite."""
    if pose is None or np.shape(pose) != (4, 4) or not np.isfinite(pose).all():
        return False
    rotation = np.asarray(pose, float)[:3, :3]
    return bool(np.abs(rotation @ rotation.T - np.eye(3)).max() < NOT_RIGID
                and np.linalg.det(rotation) > 0)


def next_ego(ego: Ego, pose: np.ndarray | None, seconds: float, max_gap: float) -> Ego:
    """The sensor `seconds` after ego; pose None where it is missing: then it moves on as before,
    for max_gap seconds."""
    if pose is not None:
        pose = np.asarray(pose, np.float64)
        since = seconds + ego.missing
        if not ego.known or since <= 0:
            return Ego(pose, ego.velocity, ego.rotation, 0.0, True)
        start = ego.pose @ np.linalg.inv(_moved(ego, min(ego.missing, max_gap)))
        step = np.linalg.inv(start) @ pose
        return Ego(pose, step[:3, 3] / since,
                   Rotation.from_matrix(step[:3, :3]).as_rotvec() / since, 0.0, True)
    on = max(min(seconds, max_gap - ego.missing), 0.0)
    return Ego(ego.pose @ _moved(ego, on), ego.velocity, ego.rotation, ego.missing + seconds,
               ego.known)


def _moved(ego: Ego, seconds: float) -> np.ndarray:
    step = np.eye(4)
    step[:3, :3] = Rotation.from_rotvec(ego.rotation * seconds).as_matrix()
    step[:3, 3] = ego.velocity * seconds
    return step


def jumped(ego: Ego, pose: np.ndarray, seconds: float) -> bool:
    """Whether a pose is so far from the last one that no sensor drives there in so many seconds."""
    apart = np.linalg.norm(np.asarray(pose, float)[:3, 3] - ego.pose[:3, 3])
    return ego.known and bool(apart > MAX_SPEED * (seconds + ego.missing) + 1.0)


def best_source(wanted: str, there: Collection[str]) -> str:
    """Whence the sensor's motion is known: of the SOURCES that are there the wanted one, and with
    "auto" the best; NO_SOURCE where there is no such."""
    return next((name for name in SOURCES if name in there and wanted in ("auto", name)),
                NO_SOURCE)


def recorded_source(poses: bool, wanted: str = "auto") -> str:
    """best_source of recorded frames, which have poses or not. One that is wanted by name is taken
    to be there, as it says itself where it is not."""
    return best_source(wanted, {wanted, *["recording"] * poses, *["kiss_icp"] * has_odometry()})


def recorded_poses(source: str) -> Callable[[Frame], np.ndarray | None]:
    """pose_of(frame) -> pose (4, 4) or None, for the frames of one drive in their order; source as
    of recorded_source. InputError where KISS-ICP, which loads each frame, is not installed."""
    if source == "kiss_icp":
        odometry = Odometry()
        return lambda frame: odometry(frame.load().xyz)
    return lambda frame: frame.pose() if source == "recording" else None


def has_odometry() -> bool:
    """Whether Odometry can be made: the extra [odometry] is installed."""
    return importlib.util.find_spec("kiss_icp") is not None


class Odometry:
    """odometry(xyz (N, 3)) -> pose (4, 4) of the scan in the frame of the first, by KISS-ICP
    (Vizzo et al., RA-L 2023). InputError where it is not installed.

    It runs in one thread, so that the same scans give the same poses, and registers one point in
    each COARSE voxels, where that leaves ENOUGH.
    """

    def __init__(self, voxel: float = 1.0) -> None:
        try:
            from kiss_icp.config.parser import KISSConfig
            from kiss_icp.kiss_icp import KissICP
            from kiss_icp.voxelization import voxel_down_sample
        except ImportError:
            raise InputError("ego motion from the scans needs kiss-icp; pip install "
                             "'lidar_perception[odometry]'") from None
        config = KISSConfig()
        config.mapping.voxel_size, config.data.deskew = voxel, False
        config.registration.max_num_threads = 1
        config.registration.convergence_criterion = CONVERGED

        def voxelize(scan: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            """What is registered, and what goes into the map."""
            mapped = voxel_down_sample(scan, MAPPED * voxel)
            few = voxel_down_sample(mapped, COARSE * voxel)
            return few if len(few) >= ENOUGH else voxel_down_sample(mapped, FINE * voxel), mapped

        self._icp = KissICP(config)
        self._icp.voxelize = voxelize

    def __call__(self, xyz: np.ndarray) -> np.ndarray:
        """The pose of the next scan (N, 3)."""
        self._icp.register_frame(np.asarray(xyz, np.float64), np.zeros(0))
        return np.array(self._icp.last_pose)
