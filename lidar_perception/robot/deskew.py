"""Motion correction (deskewing): transforms the points of a sweep to a common time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

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
