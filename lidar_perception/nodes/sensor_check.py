"""Whether the parameters fit the sensor: its height and the scale of its intensity."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidar_perception.ground.params import SensorPoseParams
from lidar_perception.ground.segment import height_problem, measured_height
from lidar_perception.types import LidarFrame
from lidar_perception.wire.messages import intensity_problem, to_frame

CLOUDS = 5  # on which the height is measured


class SensorCheck:
    """Measures the sensor's height on the first clouds, and again when sensor_pose changes. node
    has the parameter groups input and ground."""

    def __init__(self, node: Any):
        self.node = node
        self.pose: SensorPoseParams | None = None
        self.heights: list[float | None] = []

    def frame(self, msg: Any) -> tuple[LidarFrame, np.ndarray]:
        """to_frame(msg), with the intensity where the ground method uses it."""
        params = self.node.params
        reads_intensity = params.ground.method == "patchwork"
        return to_frame(msg, params.input.intensity_max if reads_intensity else None)

    def problem(self, frame: LidarFrame) -> str | None:
        """What does not fit, with the remedy; None if nothing is known against the parameters."""
        return self._height_problem(frame) or intensity_problem(frame)

    def _height_problem(self, frame: LidarFrame) -> str | None:
        pose = self.node.params.ground.sensor_pose
        if pose != self.pose:
            self.pose, self.heights = pose, []
        if len(self.heights) < CLOUDS:
            self.heights.append(measured_height(frame.xyz, pose))
        known = [h for h in self.heights if h is not None]
        if not known:
            return None
        height = float(np.median(known))
        self.node.counts["sensor_height"] = f"{height:.2f}"
        return height_problem(height, pose)
