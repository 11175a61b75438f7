"""Mounting of a cloud's sensor, and the frame in which its results are published."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lidar_perception.robot.poses import invert_pose, transform_points
from lidar_perception.types import PointCloud

MIN_TILT_RAD = 1e-9  # smaller tilts are rounding errors


@dataclass(frozen=True, eq=False)
class Placement:
    """Placement of one cloud.

    frame_id: frame of the results.
    base: (4, 4) pose of the sensor in a frame on the ground; None if unknown.
    level: (4, 4) transform of points to the level frame, which is at the same place with z up as
        in base and x where the detectors look; None for the identity.
    out: (4, 4) transform of boxes from the level frame to frame_id; None for the identity.
    """

    frame_id: str
    base: np.ndarray | None = None
    level: np.ndarray | None = None
    out: np.ndarray | None = None

    def level_frame(self, frame: PointCloud) -> PointCloud:
        """Return the cloud in the level frame; the cloud itself if it is level already."""
        return frame if self.level is None else replace(frame, xyz=transform_points(frame.xyz, self.level))

    def to_cloud_frame(self, xyz: np.ndarray) -> np.ndarray:
        """Transform points (N, 3) from the level frame to the cloud's frame."""
        return xyz if self.level is None else transform_points(xyz, invert_pose(self.level))


def find_roll_pitch(base: np.ndarray) -> tuple[float, float]:
    """Return roll and pitch of a pose (4, 4) in an upright frame, in radians as in a URDF's rpy."""
    return (float(np.arctan2(base[2, 1], base[2, 2])), float(np.arctan2(-base[2, 0], np.hypot(base[2, 1], base[2, 2]))))


def make_tilted_pose(roll: float, pitch: float, height: float = 0.0) -> np.ndarray:
    """Return the pose (4, 4) of a sensor at (0, 0, height), rotated by roll about x, then by pitch
    about y, in radians."""
    (sr, sp), (cr, cp) = np.sin([roll, pitch]), np.cos([roll, pitch])
    return np.array(
        [[cp, sp * sr, sp * cr, 0.0], [0.0, cr, -sr, 0.0], [-sp, cp * sr, cp * cr, height], [0.0, 0.0, 0.0, 1.0]]
    )


def find_level_transform(base: np.ndarray, ahead: float = 0.0) -> np.ndarray | None:
    """Return Placement.level for this base, None if it is the identity.

    ahead: direction in which the detectors look, in radians counter-clockwise from the sensor's x.
    """
    roll, pitch = find_roll_pitch(base)
    level = None if max(abs(roll), abs(pitch)) < MIN_TILT_RAD else make_tilted_pose(roll, pitch)
    if not ahead:
        return level
    s, c = np.sin(ahead), np.cos(ahead)
    turn = np.eye(4)
    turn[:2, :2] = [[c, s], [-s, c]]
    return turn if level is None else turn @ level
