"""Conversion of frames from a tilted or rotated sensor to frames of a level sensor with x forward."""

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
from lidar_perception.types import GroundTruth, PointCloud
from lidar_perception.wire.messages import to_point_cloud
from lidar_perception.wire.point_times import deskew_frame
from lidar_perception.wire.topics import LIDAR_FRAME


@dataclass(frozen=True)
class SensorMount:
    """Mounting of a sensor, and the parameters with which nodes read its clouds.

    Attributes:
        height: metres above the ground; None to keep the height in the recording.
        roll, pitch: orientation of the sensor in radians, as in a URDF's rpy.
        ahead: direction of travel, counter-clockwise from the sensor's x axis, radians.
        crop: the robot's body in sensor coordinates.
        intensity_max: intensity of a full reflection; 0 to keep the scale of the recording.
    """

    height: float | None = None
    roll: float = 0.0
    pitch: float = 0.0
    ahead: float = 0.0
    crop: CropParams = CropParams()
    intensity_max: float = 0.0


def level_frame(frame: Frame, mount: SensorMount, poses: PoseLookup | None = None) -> Frame:
    """Convert a frame of a bag or file to a frame of a level sensor at the same place, with x forward.

    Labels, camera and pose are transformed too; boxes stay upright. If the cloud is rotated,
    "_level" is appended to its frame_id.

    Args:
        frame: frame whose native() returns its message.
        mount: mounting of the sensor.
        poses: returns the poses (M, 4, 4) of the sensor at times (M,) ns. If given, clouds are
            motion corrected as with input.deskew, and load() raises InputError if a pose or the
            time column is missing.
    """
    rotation = find_level_transform(make_tilted_pose(mount.roll, mount.pitch), mount.ahead)
    inverse_rotation = np.eye(4) if rotation is None else invert_pose(rotation)

    def read() -> tuple[np.ndarray, PointCloud]:
        message = frame.native()
        scan, indices = to_point_cloud(message, mount.intensity_max or frame.intensity_max())
        kept_points, scan = crop_frame(scan, mount.crop, level=rotation)
        if poses is not None:
            scan = deskew_frame(message, scan, indices.take(kept_points), poses)
        return kept_points, scan

    def load() -> PointCloud:
        scan = read()[1]
        return (
            scan
            if rotation is None
            else replace(
                scan, xyz=transform_points(scan.xyz, rotation), frame_id=f"{scan.frame_id or LIDAR_FRAME}_level"
            )
        )

    def point_truth() -> PointTruth | None:
        labels = frame.point_truth()
        if labels is None or not mount.crop.enabled:
            return labels
        kept_points, _ = read()
        return PointTruth(labels.classes[kept_points], labels.instances[kept_points])

    def truth() -> GroundTruth | None:
        labels = frame.truth()
        return (
            labels
            if labels is None or rotation is None
            else replace(labels, boxes=transform_boxes(labels.boxes, rotation))
        )

    def calibration() -> Calibration | None:
        camera = frame.calibration()
        return None if camera is None else replace(camera, lidar_to_camera=camera.lidar_to_camera @ inverse_rotation)

    def pose() -> np.ndarray | None:
        sensor_pose = frame.pose()
        return None if sensor_pose is None else sensor_pose @ inverse_rotation

    height = frame.sensor_height if mount.height is None else mount.height
    return replace(
        frame,
        load=load,
        truth=truth,
        point_truth=point_truth,
        calibration=calibration,
        pose=pose,
        sensor_height=height,
        points=None,
        native=None,
    )
