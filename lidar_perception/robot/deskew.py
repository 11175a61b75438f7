"""Motion correction: points of one sweep, measured one after the other, moved to one time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from lidar_perception.robot.poses import invert_pose

# Over a sweep of 0.1 s the poses are 24 us apart; a car at 30 m/s moves by 0.7 mm in that time.
MAX_POSES = 4096

# at (M,) seconds after the stamp -> poses (M, 4, 4) of the sensor in any frame that does not move.
PoseLookup = Callable[[np.ndarray], np.ndarray]


def deskew(xyz: np.ndarray, seconds: np.ndarray, poses: PoseLookup) -> np.ndarray:
    """Move points to the sensor's frame at the stamp. The work is linear in N.

    Args:
        xyz: (N, 3) points, each in the sensor's frame at its own time; N may be 0.
        seconds: (N,) time of each point after the stamp.
        poses: motion of the sensor, looked up once for at most MAX_POSES times and the stamp.

    Returns:
        (N, 3) float32.
    """
    xyz = np.asarray(xyz, np.float32)
    if not len(xyz):
        return xyz
    low, high = float(seconds.min()), float(seconds.max())
    count = MAX_POSES if high > low else 1
    found = poses(np.append(np.linspace(low, high, count), 0.0))
    to_stamp = (invert_pose(found[-1]) @ found[:-1]).astype(np.float32)
    which = np.zeros(len(xyz), np.intp)
    if count > 1:
        which = np.rint((seconds - low) * ((count - 1) / (high - low))).astype(np.intp)
    return np.einsum("nij,nj->ni", to_stamp[:, :3, :3].take(which, axis=0), xyz) + to_stamp[:, :3, 3].take(
        which, axis=0
    )


def skew(xyz: np.ndarray, seconds: np.ndarray, poses: PoseLookup) -> np.ndarray:
    """Invert deskew: return (N, 3) float32, the points as a moving sensor reports them.

    xyz (N, 3) are in the sensor's frame at the stamp; point i is measured at seconds[i].
    """

    def invert_poses(at: np.ndarray) -> np.ndarray:
        found = poses(at)
        return invert_pose(invert_pose(found[-1]) @ found)

    return deskew(xyz, seconds, invert_poses)


def make_constant_motion(velocity: np.ndarray, rotation: np.ndarray) -> PoseLookup:
    """Return the poses of a sensor that moves on an arc at constant speed.

    velocity (3,) in m/s and rotation (3,) in rad/s are in the sensor's own frame, as in the twist
    of a nav_msgs/Odometry.
    """
    velocity, rotation = np.asarray(velocity, np.float64), np.asarray(rotation, np.float64)

    def poses(at: np.ndarray) -> np.ndarray:
        found = np.tile(np.eye(4), (len(at), 1, 1))
        found[:, :3, :3] = Rotation.from_rotvec(at[:, None] * rotation).as_matrix()
        found[:, :3, 3] = np.einsum("mij,j->mi", _mean_rotation(at, rotation), velocity) * at[:, None]
        return found

    return poses


def _mean_rotation(at: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return (M, 3, 3) the mean rotation from 0 to each time of at (M,): SO(3)'s left Jacobian.

    It maps the velocity to the distance travelled divided by the time.
    """
    speed = float(np.linalg.norm(rotation))
    if speed == 0.0:
        return np.tile(np.eye(3), (len(at), 1, 1))
    x, y, z = rotation / speed
    axis = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.where(np.abs(at * speed) < 1e-4, 1.0, at * speed)
    small = np.abs(at * speed) < 1e-4
    first = np.where(small, at * speed / 2, (1 - np.cos(angle)) / angle)
    second = np.where(small, (at * speed) ** 2 / 6, 1 - np.sin(angle) / angle)
    return np.eye(3) + first[:, None, None] * axis + second[:, None, None] * (axis @ axis)
