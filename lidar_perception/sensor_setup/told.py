"""What a recording itself says: where the sensor is mounted, and how the robot moved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from lidar_perception.data.bag_poses import BagPoses
from lidar_perception.robot.placement import find_roll_pitch
from lidar_perception.robot.poses import invert_pose
from lidar_perception.robot.transform_tree import MissingTransform

FOOTPRINT = "base_footprint"  # on the ground below base_link (REP-120)


class Told(NamedTuple):
    """base: the robot's frame, "" for none; mount (4, 4): the sensor's pose in it, None where TF
    does not say it; footprint (4, 4): likewise in base_footprint; poses: of the base, or without
    one of the sensor, in a frame that stands, by the number of the cloud; left_out: transforms and
    odometry that are no poses; unposed: why most clouds have no pose though the recording has
    some, "" where they have, or it has none."""

    base: str = ""
    mount: np.ndarray | None = None
    footprint: np.ndarray | None = None
    poses: Mapping[int, np.ndarray] = {}
    left_out: int = 0
    unposed: str = ""

    @property
    def roll_pitch(self) -> tuple[float, float]:
        """Degrees, of the sensor in the base; NaN where that is not told."""
        if self.mount is None:
            return np.nan, np.nan
        roll, pitch = np.degrees(find_roll_pitch(self.mount))
        return float(roll), float(pitch)

    @property
    def height(self) -> float:
        """Metres of the sensor above base_footprint; NaN where that is not told."""
        return np.nan if self.footprint is None else float(self.footprint[2, 3])

    @property
    def ahead(self) -> float:
        """Degrees from x of the levelled sensor to x of the base, counter-clockwise; NaN where that
        is not told."""
        return np.nan if self.mount is None else float(
            -np.degrees(np.arctan2(self.mount[1, 0], self.mount[0, 0])))


NOTHING = Told()


def told_by(poses: BagPoses | None, numbers: Sequence[int], stamps_ns: np.ndarray | None) -> Told:
    """What the odometry and TF of a bag say; poses None: nothing is told."""
    if poses is None or stamps_ns is None or not (poses.base or poses.odometry):
        return NOTHING
    base = poses.base
    mount = poses.find_mount(base) if base else None
    moved = {}
    # Odometry that does not say what it is of does not say where the base went.
    nameless = poses.odometry and not poses.carrier
    for number in () if nameless else numbers:
        pose = _base_pose(poses, int(stamps_ns[number]), mount if base else np.eye(4))
        if pose is not None:
            moved[number] = pose
    unposed = "" if 2 * len(moved) >= len(numbers) or not poses.available else (
        "its odometry does not say in child_frame_id what it is of" if nameless else
        f"{len(numbers) - len(moved)} of {len(numbers)} clouds have no pose at their time")
    return Told(base, mount, poses.find_mount(FOOTPRINT), moved, poses.invalid_count, unposed)


def _base_pose(poses: BagPoses, stamp_ns: int, mount: np.ndarray | None) -> np.ndarray | None:
    if poses.carrier == poses.base:
        try:
            return poses.carrier_pose(stamp_ns)
        except MissingTransform:
            return None
    pose = poses(stamp_ns)
    return None if pose is None or mount is None else pose @ invert_pose(mount)
