"""Motion correction (deskewing): transforms the points of a sweep to a common time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from lidar_perception.robot.poses import invert_pose

# In a sweep of 0.1 s, the poses are 24 us apart; a car at 30 m/s moves by 0.7 mm in that time.
MAX_POSES = 4096

# Function that returns the poses (M, 4, 4) of the sensor in any fixed frame at times (M,), in
# seconds after the stamp.
PoseLookup = Callable[[np.ndarray], np.ndarray]


def deskew(xyz: np.ndarray, seconds: np.ndarray, poses: PoseLookup) -> np.ndarray:
    """Transform points to the sensor's frame at the stamp. Run time is linear in N.

    Args:
        xyz: (N, 3) points, each in the sensor's frame at its own time; N may be 0.
        seconds: (N,) time of each point, relative to the stamp.
        poses: Motion of the sensor, called once with at most MAX_POSES times and the stamp.

    Returns:
        (N, 3) float32.
    """
    xyz = np.asarray(xyz, np.float32)
    if not len(xyz):
        return xyz
    low, high = float(seconds.min()), float(seconds.max())
    count = MAX_POSES if high > low else 1
    sensor_poses = poses(np.append(np.linspace(low, high, count), 0.0))
    to_stamp = (invert_pose(sensor_poses[-1]) @ sensor_poses[:-1]).astype(np.float32)
    pose_index = np.zeros(len(xyz), np.intp)
    if count > 1:
        pose_index = np.rint((seconds - low) * ((count - 1) / (high - low))).astype(np.intp)
    return np.einsum("nij,nj->ni", to_stamp[:, :3, :3].take(pose_index, axis=0), xyz) + to_stamp[:, :3, 3].take(
        pose_index, axis=0
    )


def make_constant_motion(velocity: np.ndarray, rotation: np.ndarray) -> PoseLookup:
    """Make the motion of a sensor with a constant twist.

    velocity (3,) in m/s and rotation (3,) in rad/s are in the sensor's own frame, as in the twist
    of a nav_msgs/Odometry.
    """
    velocity, rotation = np.asarray(velocity, np.float64), np.asarray(rotation, np.float64)

    def compute_poses(at: np.ndarray) -> np.ndarray:
        matrices = np.tile(np.eye(4), (len(at), 1, 1))
        matrices[:, :3, :3] = Rotation.from_rotvec(at[:, None] * rotation).as_matrix()
        matrices[:, :3, 3] = np.einsum("mij,j->mi", _compute_mean_rotation(at, rotation), velocity) * at[:, None]
        return matrices

    return compute_poses


def _compute_mean_rotation(at: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return the mean rotation (M, 3, 3) from 0 to each time of at (M,): the left Jacobian of SO(3).

    It maps the velocity to the mean velocity in the frame at time 0.
    """
    speed = float(np.linalg.norm(rotation))
    if speed == 0.0:
        return np.tile(np.eye(3), (len(at), 1, 1))
    x, y, z = rotation / speed
    axis = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.where(np.abs(at * speed) < 1e-4, 1.0, at * speed)
    is_small = np.abs(at * speed) < 1e-4
    sine_factor = np.where(is_small, at * speed / 2, (1 - np.cos(angle)) / angle)
    cross_factor = np.where(is_small, (at * speed) ** 2 / 6, 1 - np.sin(angle) / angle)
    return np.eye(3) + sine_factor[:, None, None] * axis + cross_factor[:, None, None] * (axis @ axis)
