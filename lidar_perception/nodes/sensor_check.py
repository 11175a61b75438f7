"""Conversion of cloud messages to frames, and checks of the sensor height and the intensity."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lidar_perception.data.mount_check import find_height_problem, measure_sensor_height
from lidar_perception.ground.params import SensorPoseParams
from lidar_perception.intensity import StreamScale, find_scale_problem
from lidar_perception.robot.params import CropParams
from lidar_perception.types import PointCloud
from lidar_perception.wire.messages import to_point_cloud

MEASURED_CLOUDS = 5  # number of clouds used to measure the sensor height


class SensorCheck:
    """Converts clouds to frames, and checks that the parameters describe the sensor.

    The sensor height is measured on the first clouds, and again after a change of sensor_pose. The
    node must have the parameter groups input, crop and ground.
    """

    def __init__(self, node: Any):
        self.node = node
        self.pose: SensorPoseParams | None = None
        self.heights: list[float | None] = []
        self.scale = StreamScale()

    def read_frame(self, msg: Any, with_intensity: bool = False) -> tuple[PointCloud, np.ndarray, Any]:
        """Convert a cloud to a cropped frame, in the level frame if there is a base_frame.

        Args:
            msg: the cloud.
            with_intensity: read the intensity even if the ground method does not use it.

        Returns:
            The frame; the indices (N,) of its points in the cloud; and the parameters of the node,
            adapted to the cropped frame.
        """
        params = self.node.params
        reads_intensity = with_intensity or params.ground.method == "patchwork"
        frame, indices = to_point_cloud(msg, params.input.intensity_max if reads_intensity else None, self.scale)
        placement = self.node.transforms.find_placement(msg.header)
        params = self.node.transforms.with_mounting(params, placement)
        self.node.diagnostics.counts.pop("cropped", None)
        if params.crop.enabled:
            cropped_indices, frame = self.node.transforms.crop_frame(frame, params.crop, placement)
            self.node.diagnostics.counts["cropped"] = len(indices) - len(cropped_indices)
            indices, params = indices.take(cropped_indices), replace(params, crop=CropParams())
        return placement.level_frame(frame), indices, params

    def find_problem(self, frame: PointCloud, params: Any) -> str | None:
        """Return a message if the frame contradicts the parameters from read_frame(), or None."""
        return self.check_height(frame, params.ground.sensor_pose) or find_scale_problem(frame.intensity)

    def check_height(self, frame: PointCloud, pose: SensorPoseParams) -> str | None:
        """Return a message if the measured sensor height differs from the height in pose, or None."""
        if pose != self.pose:
            self.pose, self.heights = pose, []
        if len(self.heights) < MEASURED_CLOUDS:
            self.heights.append(measure_sensor_height(frame.xyz, pose))
        measured_heights = [h for h in self.heights if h is not None]
        if not measured_heights:
            return None
        height = float(np.median(measured_heights))
        self.node.diagnostics.counts["sensor_height"] = f"{height:.2f}"
        return find_height_problem(height, pose)
