"""Where the sensor of one cloud is mounted, and the frame that its results go out in."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lidar_perception.robot.poses import inverse, moved_points
from lidar_perception.types import LidarFrame

STRAIGHT = 1e-9  # rad; a smaller tilt is rounding


@dataclass(frozen=True, eq=False)
class Placing:
    """Of one cloud. base (4, 4): the sensor's pose in a frame on the ground; level (4, 4): takes
    its points to the level frame, the same place with z up as in base and x where the detectors
    look; frame_id, out (4, 4): the frame of the results, and what takes boxes of the level frame
    there. None is the identity, and of base: not known."""

    frame_id: str
    base: np.ndarray | None = None
    level: np.ndarray | None = None
    out: np.ndarray | None = None

    def levelled(self, frame: LidarFrame) -> LidarFrame:
        """The frame as of a level sensor at the same place; itself where it is level."""
        return frame if self.level is None else replace(
            frame, xyz=moved_points(frame.xyz, self.level))

    def in_cloud(self, xyz: np.ndarray) -> np.ndarray:
        """Points (N, 3) of the level frame in the cloud's; xyz itself where these are the same."""
        return xyz if self.level is None else moved_points(xyz, inverse(self.level))


def roll_pitch(base: np.ndarray) -> tuple[float, float]:
    """rad, of a sensor with this pose (4, 4) in a frame that stands upright, as a URDF's rpy."""
    return (float(np.arctan2(base[2, 1], base[2, 2])),
            float(np.arctan2(-base[2, 0], np.hypot(base[2, 1], base[2, 2]))))


def tilted(roll: float, pitch: float, height: float = 0.0) -> np.ndarray:
    """(4, 4): the pose of a sensor so high above the ground below it, turned by roll about x, then
    by pitch about y."""
    (sr, sp), (cr, cp) = np.sin([roll, pitch]), np.cos([roll, pitch])
    return np.array([[cp, sp * sr, sp * cr, 0.0], [0.0, cr, -sr, 0.0],
                     [-sp, cp * sr, cp * cr, height], [0.0, 0.0, 0.0, 1.0]])


def levelling(base: np.ndarray, ahead: float = 0.0) -> np.ndarray | None:
    """level of a Placing with this base, for detectors that look ahead, rad counter-clockwise from
    where x of the sensor looks; None where that is the sensor's own frame."""
    roll, pitch = roll_pitch(base)
    level = None if max(abs(roll), abs(pitch)) < STRAIGHT else tilted(roll, pitch)
    if not ahead:
        return level
    s, c = np.sin(ahead), np.cos(ahead)
    turn = np.eye(4)
    turn[:2, :2] = [[c, s], [-s, c]]
    return turn if level is None else turn @ level
