"""Clouds as seen from a level sensor at SENSOR_HEIGHT, the input of the networks."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from lidar_perception.classes import CAR
from lidar_perception.geometry import wrap_angle
from lidar_perception.ground.params import GroundParams, SensorPoseParams
from lidar_perception.ground.segment import level_points, segment_ground
from lidar_perception.ground.surface import GroundSurface
from lidar_perception.intensity import MIN_POINTS, normalize_intensity
from lidar_perception.types import SENSOR_HEIGHT, Detections, PointCloud

MAX_MAST_M = 1.0  # maximum vertical gap between the ego vehicle and a sensor above it
MAX_ROOF_GAP_M = 1.0  # maximum horizontal gap to the ego vehicle's roof; cars in other lanes are farther away

Corner = tuple[float, float, float]  # corner of a range: x, y, z in metres


@dataclass(frozen=True)
class NormalizedView:
    """A cloud as a level sensor SENSOR_HEIGHT above the ground would have measured it.

    Attributes:
        frame: the M points in the view. Their intensity is normalized, or None if the cloud has no
            usable intensity.
        indices: (M,) int64 indices of these points in `source`.
        source: the original cloud of N points in sensor coordinates.
        pose: mounting pose of the sensor.
        use_intensity: False if the view ignores the intensity.
    """

    frame: PointCloud
    indices: np.ndarray
    source: PointCloud
    pose: SensorPoseParams
    use_intensity: bool

    @staticmethod
    def of(
        source: PointCloud,
        pose: SensorPoseParams = SensorPoseParams(),
        low: Corner | None = None,
        high: Corner | None = None,
        use_intensity: bool = True,
    ) -> NormalizedView:
        """Make the view of a cloud.

        Args:
            low, high: range of the view, low <= x y z < high; other points and points with NaN are
                dropped. None: keep all points.
            use_intensity: False sets the intensity to None. (Zeros would change the results of
                Patchwork++, which removes dark points below the ground as reflections.)
        """
        shift = np.array([0, 0, pose.height - SENSOR_HEIGHT], np.float32)
        xyz, indices = level_points(source.xyz, pose), None
        if low is not None and high is not None:
            indices, xyz = _select_in_range(
                np.ascontiguousarray(xyz), np.array(low, np.float32) - shift, np.array(high, np.float32) - shift
            )
        intensity = normalize_intensity(source.intensity, indices) if use_intensity else None
        frame = replace(source, xyz=xyz + shift, intensity=intensity)
        indices = np.arange(len(source)) if indices is None else indices
        return NormalizedView(frame, indices, source, pose, use_intensity)

    def __len__(self) -> int:
        return len(self.frame)

    def crop(self, low: Corner, high: Corner) -> NormalizedView:
        """Return the points of the view with low <= x y z < high."""
        indices, frame = crop_to_range(self.frame, low, high)
        return replace(self, frame=frame, indices=self.indices[indices])

    def flatten(self, surface: GroundSurface) -> NormalizedView:
        """Move all points vertically, so that the ground is SENSOR_HEIGHT below the sensor everywhere."""
        xyz = self.frame.xyz.copy()
        xyz[:, 2] -= surface.height_at(xyz) + SENSOR_HEIGHT
        return replace(self, frame=replace(self.frame, xyz=xyz))

    def take(self, column: np.ndarray | None) -> np.ndarray | None:
        """Return the values (M,) of a column (N,) of the source at the points of this view; None for None."""
        return None if column is None else column.take(self.indices)

    def transfer(self, column: np.ndarray | None, other: NormalizedView) -> np.ndarray | None:
        """Transfer a column (M,) of this view to the K points of another view of the same source.

        Points that are not in this view get 0. The result is None if the column is None.
        """
        if column is None:
            return None
        values = np.zeros(len(self.source), column.dtype)
        values[self.indices] = column
        return values.take(other.indices)

    def find_intensity_problem(self) -> str | None:
        """Return the reason why the intensity is unusable; None if it is usable or ignored."""
        intensity = self.source.intensity
        if (
            not self.use_intensity
            or self.frame.intensity is not None
            or (intensity is not None and len(intensity) < MIN_POINTS)
        ):
            return None
        defect = "has the same intensity nearly everywhere"
        if intensity is None:
            defect = "has no intensity"
        elif not intensity.any():
            defect = "has the intensity 0 everywhere"
        return (
            f"the cloud {defect}, so fewer people are detected; set use_intensity to false if the sensor has no "
            "intensity"
        )


@njit(cache=True, nogil=True)
def _select_in_range(xyz, low, high):
    """Return the indices (M,) int64 of the points (N, 3) with low <= x y z < high, and these points (M, 3)."""
    indices, count = np.empty(len(xyz), np.int64), 0
    for i in range(len(xyz)):  # without branches, because their outcome is hard to predict
        indices[count] = i
        x, y, z = xyz[i]
        count += (low[0] <= x) & (x < high[0]) & (low[1] <= y) & (y < high[1]) & (low[2] <= z) & (z < high[2])
    selected = np.empty((count, 3), xyz.dtype)
    for i in range(count):
        for axis in range(3):  # Numba takes seconds to compile an assignment of rows
            selected[i, axis] = xyz[indices[i], axis]
    return indices[:count].copy(), selected


def crop_to_range(frame: PointCloud, low: Corner, high: Corner) -> tuple[np.ndarray, PointCloud]:
    """Crop a frame to low <= x y z < high; return the indices (M,) int64 and the cropped frame."""
    indices, xyz = _select_in_range(
        np.ascontiguousarray(frame.xyz), np.array(low, np.float32), np.array(high, np.float32)
    )
    intensity = None if frame.intensity is None else frame.intensity.take(indices)
    return indices, replace(frame, xyz=xyz, intensity=intensity)


def segment_view_ground(frame: PointCloud, params: GroundParams) -> np.ndarray:
    """Return the ground mask (M,) bool of a NormalizedView's frame, ignoring the pose in `params`."""
    return segment_ground(frame, replace(params, sensor_pose=SensorPoseParams()))


def restore_detections(detections: Detections, pose: SensorPoseParams) -> Detections:
    """Transform detections of a NormalizedView to sensor coordinates and drop the ego vehicle."""
    return to_sensor_frame(drop_ego_vehicle(detections, pose.height), pose)


def to_sensor_frame(detections: Detections, pose: SensorPoseParams) -> Detections:
    """Transform detections of a NormalizedView to sensor coordinates."""
    boxes = detections.boxes.copy()
    boxes[:, 2] -= pose.height - SENSOR_HEIGHT
    if pose.roll or pose.pitch:
        rotation = level_points(np.eye(3, dtype=np.float32), pose).T
        heading = np.stack([np.cos(boxes[:, 6]), np.sin(boxes[:, 6])], axis=1) @ rotation[:2]
        boxes[:, :3] = boxes[:, :3] @ rotation
        boxes[:, 6] = np.arctan2(heading[:, 1], heading[:, 0])
    return replace(detections, boxes=boxes)


def drop_ego_vehicle(detections: Detections, height: float) -> Detections:
    """Remove detections of the ego vehicle, in the coordinates of a NormalizedView.

    Boxes are removed if they contain the sensor or are less than MAX_MAST_M above or below it. The
    ego vehicle's roof is only partly visible, so cars below the sensor are also removed if they are
    less than MAX_ROOF_GAP_M away horizontally.

    Args:
        height: actual height of the sensor above the ground in metres.
    """
    x, y, z, length, width, box_height, yaw = detections.boxes.astype(np.float64).T
    z = z - (height - SENSOR_HEIGHT)
    gap_x = np.abs(np.cos(yaw) * x + np.sin(yaw) * y) - length / 2
    gap_y = np.abs(np.cos(yaw) * y - np.sin(yaw) * x) - width / 2
    distance = np.hypot(gap_x.clip(0), gap_y.clip(0))
    is_roof = (detections.class_ids == CAR) & (z + box_height / 2 < 0) & (distance < MAX_ROOF_GAP_M)
    is_ego_vehicle = ((distance == 0) | is_roof) & (np.abs(z) <= box_height / 2 + MAX_MAST_M)
    return detections[~is_ego_vehicle] if is_ego_vehicle.any() else detections


def rotate_half_turn(frame: PointCloud) -> PointCloud:
    """Return the frame rotated by 180 degrees about z, without rounding."""
    return replace(frame, xyz=frame.xyz * np.array([-1, -1, 1], np.float32))


def rotate_boxes_half_turn(boxes: np.ndarray) -> np.ndarray:
    """Return boxes (K, 7) rotated by 180 degrees about z."""
    rotated_boxes = boxes * np.array([-1, -1, 1, 1, 1, 1, 1], boxes.dtype)
    rotated_boxes[:, 6] = wrap_angle(rotated_boxes[:, 6] + np.pi)
    return rotated_boxes
