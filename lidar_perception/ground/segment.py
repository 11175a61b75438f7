"""Ground segmentation of a cloud with a selectable method."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from lidar_perception.ground.cloth import segment_by_cloth
from lidar_perception.ground.params import GroundParams, SensorPoseParams
from lidar_perception.ground.patchwork import segment_by_patchwork
from lidar_perception.ground.threshold import segment_by_threshold
from lidar_perception.intensity import guess_scale, to_unit
from lidar_perception.robot.crop import crop_frame
from lidar_perception.robot.params import CropParams
from lidar_perception.robot.placement import find_level_transform, make_tilted_pose
from lidar_perception.types import PointCloud, are_usable_returns, as_point_cloud

METHODS = {  # xyz (M, 3) level, intensity (M,) or None, params -> (M,) bool
    "threshold": lambda xyz, intensity, p: segment_by_threshold(xyz, p.threshold, p.sensor_pose.height),
    "patchwork": lambda xyz, intensity, p: segment_by_patchwork(xyz, intensity, p.sensor_pose.height, p.patchwork),
    "cloth": lambda xyz, intensity, p: segment_by_cloth(xyz, p.cloth),
}


def segment_ground(cloud: PointCloud | ArrayLike, params: GroundParams = GroundParams()) -> np.ndarray:
    """Segment the ground of a cloud.

    Args:
        cloud: a PointCloud, or an array (N, 3) or (N, 4) as PointCloud.of takes it. It is not
            modified; sensor_pose levels a copy of the points.

    Returns:
        (N,) bool, True = ground; False for points at the origin or with values that are not finite.
        An empty cloud gives (0,).

    Raises:
        InputError: the array has another shape or type.
    """
    frame = as_point_cloud(cloud)
    is_usable = are_usable_returns(frame.xyz)
    if is_usable.all():
        return _segment(frame.xyz, frame.intensity, params)
    ground = np.zeros(len(frame), bool)
    intensity = None if frame.intensity is None else frame.intensity[is_usable]
    ground[is_usable] = _segment(frame.xyz[is_usable], intensity, params)
    return ground


def _segment(xyz: np.ndarray, intensity: np.ndarray | None, params: GroundParams) -> np.ndarray:
    if intensity is not None and (full_scale := guess_scale(intensity)) != 1.0:
        intensity = to_unit(intensity, full_scale)
    return METHODS[params.method](level_points(xyz, params.sensor_pose), intensity, params)


def level_points(xyz: np.ndarray, pose: SensorPoseParams) -> np.ndarray:
    """Rotate points (N, 3) float32 into the frame of a level sensor at the same place.

    The rotation is roll about x, then pitch about y, like rpy in URDF. If both are 0, xyz itself is
    returned.
    """
    if pose.roll == pose.pitch == 0.0:
        return xyz
    return xyz @ make_tilted_pose(pose.roll, pose.pitch)[:3, :3].T.astype(np.float32)


def crop_with_sensor_pose(frame: PointCloud, crop: CropParams, pose: SensorPoseParams) -> tuple[np.ndarray, PointCloud]:
    """Crop a frame as robot.crop.crop_frame does, with sectors in the frame of a level sensor."""
    return crop_frame(frame, crop, level=find_level_transform(make_tilted_pose(pose.roll, pose.pitch)))
