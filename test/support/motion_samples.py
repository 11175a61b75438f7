"""Points as a moving sensor measures them."""

from __future__ import annotations

from lidar_perception.robot.deskew import deskew
from lidar_perception.robot.poses import invert_pose


def skew(xyz, seconds, poses):
    """Invert deskew: return the points (N, 3) as a sensor with these poses measures them."""

    def invert_poses(at):
        sensor_poses = poses(at)
        return invert_pose(invert_pose(sensor_poses[-1]) @ sensor_poses)

    return deskew(xyz, seconds, invert_poses)
