"""Recorded poses: the mount of the sensor, and the motion of the robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from lidar_perception.data.bag_poses import BagPoses
from lidar_perception.robot.placement import find_roll_pitch
from lidar_perception.robot.poses import invert_pose
from lidar_perception.robot.transform_tree import MissingTransform

FOOTPRINT = "base_footprint"  # frame on the ground below base_link (REP-120)


class RecordedPoses(NamedTuple):
    """Poses from the TF and odometry of a recording.

    Attributes:
        base: Base frame of the robot, "" if unknown.
        mount: (4, 4) pose of the sensor in the base; None if TF does not contain it.
        footprint: (4, 4) pose of the sensor in base_footprint; None if TF does not contain it.
        poses: (4, 4) pose of the base in a fixed frame, by cloud number; pose of the sensor if
            there is no base.
        invalid_count: Number of transforms and odometry messages with invalid poses.
        problem: Reason why most clouds have no pose although the recording has poses; "" for none.
    """

    base: str = ""
    mount: np.ndarray | None = None
    footprint: np.ndarray | None = None
    poses: Mapping[int, np.ndarray] = {}
    invalid_count: int = 0
    problem: str = ""

    @property
    def roll_pitch(self) -> tuple[float, float]:
        """Roll and pitch of the sensor in the base in degrees; NaN if unknown."""
        if self.mount is None:
            return np.nan, np.nan
        roll, pitch = np.degrees(find_roll_pitch(self.mount))
        return float(roll), float(pitch)

    @property
    def height(self) -> float:
        """Height of the sensor above base_footprint in metres; NaN if unknown."""
        return np.nan if self.footprint is None else float(self.footprint[2, 3])

    @property
    def heading(self) -> float:
        """Direction of the base's x axis in the levelled sensor frame, in degrees; NaN if unknown."""
        return np.nan if self.mount is None else float(-np.degrees(np.arctan2(self.mount[1, 0], self.mount[0, 0])))

    @property
    def distance(self) -> float:
        """Larger extent of the robot's path along x and y, in metres; NaN without poses."""
        return float(np.ptp([pose[:2, 3] for pose in self.poses.values()], axis=0).max()) if self.poses else np.nan


NO_POSES = RecordedPoses()


def read_recorded_poses(poses: BagPoses | None, numbers: Sequence[int], stamps_ns: np.ndarray | None) -> RecordedPoses:
    """Read the mount of the sensor and the poses of clouds from the odometry and TF of a bag.

    Args:
        poses: Poses of the bag; None for a recording without poses.
        numbers: Numbers of the clouds to look up.
        stamps_ns: Stamps of all clouds, ns; None if they have none.
    """
    if poses is None or stamps_ns is None or not (poses.base_frame or poses.odometry_topic):
        return NO_POSES
    base = poses.base_frame
    mount = poses.find_mount(base) if base else None
    cloud_poses = {}
    # Odometry without child_frame_id may refer to another frame than the base.
    has_child = not poses.odometry_topic or poses.odometry_child_frame
    for number in numbers if has_child else ():
        pose = _find_base_pose(poses, int(stamps_ns[number]), mount if base else np.eye(4))
        if pose is not None:
            cloud_poses[number] = pose
    problem = ""
    if 2 * len(cloud_poses) < len(numbers) and poses.has_poses:
        problem = f"{len(numbers) - len(cloud_poses)} of {len(numbers)} clouds have no pose at their time"
        if not has_child:
            problem = "the odometry has no child_frame_id"
    return RecordedPoses(base, mount, poses.find_mount(FOOTPRINT), cloud_poses, poses.invalid_count, problem)


def _find_base_pose(poses: BagPoses, stamp_ns: int, mount: np.ndarray | None) -> np.ndarray | None:
    if poses.odometry_child_frame == poses.base_frame:
        try:
            return poses.lookup_odometry(np.array([stamp_ns]))[0]
        except MissingTransform:
            return None
    pose = poses(stamp_ns)
    return None if pose is None or mount is None else pose @ invert_pose(mount)
