"""From a sensor's frame to what a network sees of it, and back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidar_perception.classes import CAR
from lidar_perception.detectors.pointpillars.config import NetworkConfig
from lidar_perception.geometry import wrap_angle
from lidar_perception.ground.params import GroundParams, SensorPoseParams
from lidar_perception.ground.segment import level_points, segment_ground
from lidar_perception.types import SENSOR_HEIGHT, Detections, LidarFrame

MAST = 1.0   # metres; a car that passes below a sensor on a gantry is farther away
ASIDE = 1.0  # metres; half of a car's width and the gap to the next one are more


def visible(frame: LidarFrame, config: NetworkConfig,
            pose: SensorPoseParams = SensorPoseParams()) -> tuple[np.ndarray, LidarFrame]:
    """indices (M,) int64 of the frame's points in the network's range, and the frame of these, its
    coordinates levelled and as from SENSOR_HEIGHT. Points that are not finite are left out."""
    up = np.array([0, 0, pose.height - SENSOR_HEIGHT], np.float32)
    xyz = level_points(frame.xyz, pose)
    with np.errstate(invalid="ignore"):
        inside = np.ones(len(xyz), bool)
        for axis in range(3):
            low, high = config.low[axis] - up[axis], config.high[axis] - up[axis]
            inside &= (xyz[:, axis] >= low) & (xyz[:, axis] < high)
    indices = np.flatnonzero(inside)
    seen = frame.take(indices)
    return indices, replace(seen, xyz=xyz.take(indices, axis=0) + up)


def levelled(frame: LidarFrame, pose: SensorPoseParams) -> LidarFrame:
    """All points of the frame, as from a level sensor at SENSOR_HEIGHT."""
    xyz, shift = level_points(frame.xyz, pose), np.float32(pose.height - SENSOR_HEIGHT)
    return replace(frame, xyz=xyz + np.array([0, 0, shift], np.float32) if shift else xyz)


def in_sensor_frame(detections: Detections, pose: SensorPoseParams) -> Detections:
    """Boxes as from a level sensor at SENSOR_HEIGHT, to those of a sensor with this pose."""
    boxes = detections.boxes.copy()
    boxes[:, 2] -= pose.height - SENSOR_HEIGHT
    if pose.roll or pose.pitch:
        back = level_points(np.eye(3, dtype=np.float32), pose).T
        heading = np.stack([np.cos(boxes[:, 6]), np.sin(boxes[:, 6])], axis=1) @ back[:2]
        boxes[:, :3] = boxes[:, :3] @ back
        boxes[:, 6] = np.arctan2(heading[:, 1], heading[:, 0])
    return replace(detections, boxes=boxes)


def without_carrier(detections: Detections, height: float) -> Detections:
    """Without what carries the sensor, which is nothing to find. Boxes as from a level sensor at
    SENSOR_HEIGHT that is so high in truth: those that it is in or, by less than MAST, above or
    below; and, as a roof is seen in parts, cars that it looks down on from so near and from less
    than ASIDE away."""
    x, y, z, length, width, high, yaw = detections.boxes.astype(np.float64).T
    z = z - (height - SENSOR_HEIGHT)
    along = np.abs(np.cos(yaw) * x + np.sin(yaw) * y) - length / 2
    aside = np.abs(np.cos(yaw) * y - np.sin(yaw) * x) - width / 2
    off = np.hypot(along.clip(0), aside.clip(0))
    roof = (detections.class_ids == CAR) & (z + high / 2 < 0) & (off < ASIDE)
    own = ((off == 0) | roof) & (np.abs(z) <= high / 2 + MAST)
    return detections[~own] if own.any() else detections


def as_found(detections: Detections, pose: SensorPoseParams) -> Detections:
    """What a detector finds, as from a level sensor at SENSOR_HEIGHT, as its user gets it."""
    return in_sensor_frame(without_carrier(detections, pose.height), pose)


def turned_about(frame: LidarFrame) -> LidarFrame:
    """The frame of a sensor that looks the other way: turned by 180 degrees about z, exactly."""
    return replace(frame, xyz=frame.xyz * np.array([-1, -1, 1], np.float32))


def turned_boxes(boxes: np.ndarray) -> np.ndarray:
    """Boxes (K, 7) turned likewise."""
    turned = boxes * np.array([-1, -1, 1, 1, 1, 1, 1], boxes.dtype)
    turned[:, 6] = wrap_angle(turned[:, 6] + np.pi)
    return turned


def with_intensity_scaled(frame: LidarFrame, factor: float) -> LidarFrame:
    """The frame with its intensity times factor, of 0 without any: zeros would still be read, as
    by Patchwork++, which takes what is dark and low for reflections. Itself where it has none."""
    if frame.intensity is None:
        return frame
    return replace(frame, intensity=frame.intensity * np.float32(factor) if factor else None)


def made_up_frame(pose: SensorPoseParams) -> LidarFrame:
    """Flat ground and a thing on it, for a first run of a detector."""
    rng = np.random.default_rng(0)
    flat = rng.uniform(0, 40, (2000, 3)) * [1, 1, 0.001] - [0, 20, SENSOR_HEIGHT]
    thing = rng.uniform(-0.5, 0.5, (400, 3)) + [8, 0, -0.8]
    xyz = np.concatenate([flat, thing]).astype(np.float32)
    xyz[:, 2] -= pose.height - SENSOR_HEIGHT
    return LidarFrame(xyz, np.zeros(len(xyz), np.float32))


def levelled_ground(seen: LidarFrame, params: GroundParams) -> np.ndarray:
    """(N,) bool: the ground of a frame that is levelled and as from SENSOR_HEIGHT, whatever pose
    params give its sensor."""
    return segment_ground(seen, replace(params, sensor_pose=SensorPoseParams(
        height=SENSOR_HEIGHT)))
