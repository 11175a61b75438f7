"""Mounting of a sensor, and the frame in which its results are published."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lidar_perception.robot.poses import invert_pose, transform_points
from lidar_perception.types import PointCloud

MIN_TILT_RAD = 1e-9  # smaller tilts are rounding errors


@dataclass(frozen=True, eq=False)
class Placement:
    """Mounting and frames of one cloud.

    Attributes:
        frame_id: Frame of the results.
        base: (4, 4) pose of the sensor in a frame on the ground; None if unknown.
        level: (4, 4) transform of points to the level frame; None for the identity. The level frame
            has its origin at the sensor, z up, and x in the forward direction of the detectors.
        out: (4, 4) transform of boxes from the level frame to frame_id; None for the identity.
    """

    frame_id: str
    base: np.ndarray | None = None
    level: np.ndarray | None = None
    out: np.ndarray | None = None

    def level_frame(self, frame: PointCloud) -> PointCloud:
        """Return the cloud in the level frame (the same object if it is already level)."""
        return frame if self.level is None else replace(frame, xyz=transform_points(frame.xyz, self.level))

    def to_cloud_frame(self, xyz: np.ndarray) -> np.ndarray:
        """Transform points (N, 3) from the level frame to the cloud's frame."""
        return xyz if self.level is None else transform_points(xyz, invert_pose(self.level))


def find_roll_pitch(base: np.ndarray) -> tuple[float, float]:
    """Return the roll and pitch angles of a pose (4, 4), in radians, as in the rpy of a URDF."""
    return (float(np.arctan2(base[2, 1], base[2, 2])), float(np.arctan2(-base[2, 0], np.hypot(base[2, 1], base[2, 2]))))


def make_tilted_pose(roll: float, pitch: float, height: float = 0.0) -> np.ndarray:
    """Return the pose (4, 4) of a sensor at (0, 0, height) with these angles, in radians.

    The sensor is rotated by roll about x, then by pitch about y.
    """
    (sr, sp), (cr, cp) = np.sin([roll, pitch]), np.cos([roll, pitch])
    return np.array(
        [[cp, sp * sr, sp * cr, 0.0], [0.0, cr, -sr, 0.0], [-sp, cp * sr, cp * cr, height], [0.0, 0.0, 0.0, 1.0]]
    )


def find_level_transform(base: np.ndarray, forward_yaw: float = 0.0) -> np.ndarray | None:
    """Compute Placement.level for a base, None if it is the identity.

    Args:
        base: (4, 4) pose of the sensor in a frame on the ground.
        forward_yaw: Forward direction of the detectors, in radians counter-clockwise from the sensor's x.
    """
    roll, pitch = find_roll_pitch(base)
    level = None if max(abs(roll), abs(pitch)) < MIN_TILT_RAD else make_tilted_pose(roll, pitch)
    if not forward_yaw:
        return level
    s, c = np.sin(forward_yaw), np.cos(forward_yaw)
    yaw_rotation = np.eye(4)
    yaw_rotation[:2, :2] = [[c, s], [-s, c]]
    return yaw_rotation if level is None else yaw_rotation @ level
