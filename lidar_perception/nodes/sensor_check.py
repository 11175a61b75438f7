"""Clouds as the core takes them, and a check of the sensor's parameters: its height, the scale of
its intensity."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lidar_perception.data.mount_check import find_height_problem, measure_sensor_height
from lidar_perception.ground.params import SensorPoseParams
from lidar_perception.intensity import StreamScale
from lidar_perception.robot.params import CropParams
from lidar_perception.types import LidarFrame
from lidar_perception.wire.messages import diagnose_intensity, to_frame

CLOUDS = 5  # on which the height is measured


class SensorCheck:
    """Measures the sensor's height on the first clouds, and again when sensor_pose changes, and
    keeps the scale of its intensity. node has the parameter groups input, crop and ground."""

    def __init__(self, node: Any):
        self.node = node
        self.pose: SensorPoseParams | None = None
        self.heights: list[float | None] = []
        self.scale = StreamScale()

    def frame(self, msg: Any, with_intensity: bool = False) -> tuple[LidarFrame, np.ndarray, Any]:
        """The cropped and, with base_frame, levelled frame of a cloud; the indices (N,) of its
        points in the cloud; and the node's parameters as they are for such a frame. The intensity
        is read where it is asked for, or the ground method uses it."""
        params = self.node.params
        reads_intensity = with_intensity or params.ground.method == "patchwork"
        frame, indices = to_frame(msg, params.input.intensity_max if reads_intensity else None,
                                  self.scale)
        placing = self.node.transforms.placing(msg.header)
        params = self.node.transforms.mounted(params, placing)
        self.node.counts.pop("cropped", None)
        if params.crop.enabled:
            kept, frame = self.node.transforms.cropped(frame, params.crop, placing)
            self.node.counts["cropped"] = len(indices) - len(kept)
            indices, params = indices.take(kept), replace(params, crop=CropParams())
        return placing.level_frame(frame), indices, params

    def problem(self, frame: LidarFrame, params: Any) -> str | None:
        """What does not fit the parameters that frame() gave, with the remedy; None if nothing is
        known against them."""
        return self.height_problem(frame, params.ground.sensor_pose) or diagnose_intensity(frame)

    def height_problem(self, frame: LidarFrame, pose: SensorPoseParams) -> str | None:
        """Say that the sensor is mounted at another height than pose has, by the first clouds, with
        the remedy; None if not, or not known."""
        if pose != self.pose:
            self.pose, self.heights = pose, []
        if len(self.heights) < CLOUDS:
            self.heights.append(measure_sensor_height(frame.xyz, pose))
        known = [h for h in self.heights if h is not None]
        if not known:
            return None
        height = float(np.median(known))
        self.node.counts["sensor_height"] = f"{height:.2f}"
        return find_height_problem(height, pose)
