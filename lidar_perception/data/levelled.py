"""The frames of a robot's sensor as detectors are to see them: level, x ahead, without itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.frame import Frame, PointTruth
from lidar_perception.robot.crop import cropped
from lidar_perception.robot.params import CropParams
from lidar_perception.robot.placing import levelling, tilted
from lidar_perception.robot.poses import inverse, moved_boxes, moved_points
from lidar_perception.types import GroundTruth, LidarFrame
from lidar_perception.wire.topics import LIDAR_FRAME


def levelled(frame: Frame, height: float, roll: float = 0.0, pitch: float = 0.0,
             ahead: float = 0.0, crop: CropParams = CropParams()) -> Frame:
    """The frame as a level sensor at the same place, height metres above the ground, would give it
    with x ahead, as nodes see it. roll, pitch: of the sensor, rad, as a URDF's rpy; ahead: rad
    counter-clockwise from its x axis; the crop is in its own coordinates.

    Labels, camera and pose move along; boxes stay upright. The frame_id is the sensor's with _level
    behind it."""
    level = levelling(tilted(roll, pitch), ahead)
    if level is None:
        level = np.eye(4)
    back = inverse(level)

    def load() -> LidarFrame:
        scan = cropped(frame.load(), crop)[1]
        return replace(scan, xyz=moved_points(scan.xyz, level),
                       frame_id=f"{scan.frame_id or LIDAR_FRAME}_level")

    def point_truth() -> PointTruth | None:
        labels = frame.point_truth()
        if labels is None or not crop.enabled:
            return labels
        kept = cropped(frame.load(), crop)[0]
        return PointTruth(labels.classes[kept], labels.instances[kept])

    def truth() -> GroundTruth | None:
        labels = frame.truth()
        return None if labels is None else replace(labels, boxes=moved_boxes(labels.boxes, level))

    def calibration() -> Calibration | None:
        camera = frame.calibration()
        return None if camera is None else replace(
            camera, lidar_to_camera=camera.lidar_to_camera @ back)

    def pose() -> np.ndarray | None:
        at = frame.pose()
        return None if at is None else at @ back

    return replace(frame, load=load, truth=truth, point_truth=point_truth, calibration=calibration,
                   pose=pose, sensor_height=height, points=None, native=None)
