"""Points as a moving sensor measures them, and sensors with a constant motion."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from lidar_perception.robot.deskew import PoseLookup, deskew
from lidar_perception.robot.poses import invert_pose


def skew(xyz, seconds, poses):
    """Invert deskew: return the points (N, 3) as a sensor with these poses measures them."""

    def invert_poses(at):
        sensor_poses = poses(at)
        return invert_pose(invert_pose(sensor_poses[-1]) @ sensor_poses)

    return deskew(xyz, seconds, invert_poses)


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
