"""The frames of a robot's sensor as its nodes see them: level, x ahead, without the robot."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.frame import Frame, PointTruth
from lidar_perception.robot.crop import crop_frame
from lidar_perception.robot.deskew import PoseLookup
from lidar_perception.robot.params import CropParams
from lidar_perception.robot.placement import find_level_transform, make_tilted_pose
from lidar_perception.robot.poses import invert_pose, transform_boxes, transform_points
from lidar_perception.types import GroundTruth, LidarFrame
from lidar_perception.wire.messages import to_frame
from lidar_perception.wire.point_times import deskew_frame
from lidar_perception.wire.topics import LIDAR_FRAME


@dataclass(frozen=True)
class Robot:
    """How a sensor is mounted and read, as the parameters of nodes have it. height: metres above
    the ground, None what the recording says; roll, pitch: of the sensor, as a URDF's rpy, and
    ahead: counter-clockwise from its x axis, rad; crop: its body in the sensor's coordinates;
    intensity_max: the value of a full reflection, 0 as the recording has it."""

    height: float | None = None
    roll: float = 0.0
    pitch: float = 0.0
    ahead: float = 0.0
    crop: CropParams = CropParams()
    intensity_max: float = 0.0


def levelled(frame: Frame, robot: Robot, poses: PoseLookup | None = None) -> Frame:
    """A frame of a bag or a file, whose native() gives its message, as a level sensor at the same
    place would give it, with x ahead. Labels, camera and pose move along; boxes stay upright. Where
    anything is turned the frame_id has _level behind it.

    poses: of the sensor (M, 4, 4) at times (M,) ns; with them points are moved to the stamp first,
    as input.deskew does. InputError of load() where one of these is not known, or the cloud has no
    times."""
    level = find_level_transform(make_tilted_pose(robot.roll, robot.pitch), robot.ahead)
    back = np.eye(4) if level is None else invert_pose(level)

    def read() -> tuple[np.ndarray, LidarFrame]:
        """indices of the points that are kept, and these."""
        message = frame.native()
        scan, indices = to_frame(message, robot.intensity_max or frame.intensity_max())
        kept, scan = crop_frame(scan, robot.crop, level=level)
        if poses is not None:
            scan = deskew_frame(message, scan, indices.take(kept), poses)
        return kept, scan

    def load() -> LidarFrame:
        scan = read()[1]
        return scan if level is None else replace(
            scan, xyz=transform_points(scan.xyz, level),
            frame_id=f"{scan.frame_id or LIDAR_FRAME}_level")

    def point_truth() -> PointTruth | None:
        labels = frame.point_truth()
        if labels is None or not robot.crop.enabled:
            return labels
        kept, _ = read()
        return PointTruth(labels.classes[kept], labels.instances[kept])

    def truth() -> GroundTruth | None:
        labels = frame.truth()
        return labels if labels is None or level is None else replace(
            labels, boxes=transform_boxes(labels.boxes, level))

    def calibration() -> Calibration | None:
        camera = frame.calibration()
        return None if camera is None else replace(
            camera, lidar_to_camera=camera.lidar_to_camera @ back)

    def pose() -> np.ndarray | None:
        at = frame.pose()
        return None if at is None else at @ back

    height = frame.sensor_height if robot.height is None else robot.height
    return replace(frame, load=load, truth=truth, point_truth=point_truth, calibration=calibration,
                   pose=pose, sensor_height=height, points=None, native=None)
