"""Motion correction: the points of a turn, measured one after the other, moved to one moment."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from lidar_perception.robot.poses import inverse

MOMENTS = 4096  # of a turn of 0.1 s each is 24 us, in which a car at 30 m/s moves by 0.7 mm

Poses = Callable[[np.ndarray], np.ndarray]


def deskewed(xyz: np.ndarray, seconds: np.ndarray, poses: Poses) -> np.ndarray:
    """(N, 3) float32: points (N, 3), each in the sensor's frame of the time it was measured at,
    seconds (N,) after the stamp, in the sensor's frame at the stamp. N may be 0.

    poses(at (M,) seconds after the stamp) gives the sensor's poses (M, 4, 4) in any frame that
    does not move. It is asked for MOMENTS times at most, so that the work is linear in N.
    """
    xyz = np.asarray(xyz, np.float32)
    if not len(xyz):
        return xyz
    low, high = float(seconds.min()), float(seconds.max())
    count = MOMENTS if high > low else 1
    found = poses(np.append(np.linspace(low, high, count), 0.0))
    to_stamp = (inverse(found[-1]) @ found[:-1]).astype(np.float32)
    which = np.zeros(len(xyz), np.intp)
    if count > 1:
        which = np.rint((seconds - low) * ((count - 1) / (high - low))).astype(np.intp)
    return (np.einsum("nij,nj->ni", to_stamp[:, :3, :3].take(which, axis=0), xyz)
            + to_stamp[:, :3, 3].take(which, axis=0))


def skewed(xyz: np.ndarray, seconds: np.ndarray, poses: Poses) -> np.ndarray:
    """(N, 3) float32: the inverse of deskewed, what a sensor that moves reports of points (N, 3)
    of its frame at the stamp, met at seconds (N,)."""
    def back(at: np.ndarray) -> np.ndarray:
        found = poses(at)
        return inverse(inverse(found[-1]) @ found)
    return deskewed(xyz, seconds, back)


def steady(velocity: np.ndarray, rotation: np.ndarray) -> Poses:
    """Poses of a sensor that moves evenly: velocity (3,) m/s and rotation (3,) rad/s, both in its
    own frame, as the twist of a nav_msgs/Odometry has them; on an arc."""
    velocity, rotation = np.asarray(velocity, np.float64), np.asarray(rotation, np.float64)

    def poses(at: np.ndarray) -> np.ndarray:
        found = np.tile(np.eye(4), (len(at), 1, 1))
        found[:, :3, :3] = Rotation.from_rotvec(at[:, None] * rotation).as_matrix()
        found[:, :3, 3] = np.einsum("mij,j->mi", _mean_turn(at, rotation), velocity) * at[:, None]
        return found
    return poses


def _mean_turn(at: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """(M, 3, 3): the mean of the rotations from 0 to at (M,), which takes the velocity to the way
    over time (the left Jacobian of SO(3))."""
    speed = float(np.linalg.norm(rotation))
    if speed == 0.0:
        return np.tile(np.eye(3), (len(at), 1, 1))
    x, y, z = rotation / speed
    axis = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.where(np.abs(at * speed) < 1e-4, 1.0, at * speed)
    small = np.abs(at * speed) < 1e-4
    first = np.where(small, at * speed / 2, (1 - np.cos(angle)) / angle)
    second = np.where(small, (at * speed) ** 2 / 6, 1 - np.sin(angle) / angle)
    return (np.eye(3) + first[:, None, None] * axis + second[:, None, None] * (axis @ axis))
