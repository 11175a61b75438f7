"""Node that segments the ground: ~/input/points -> ~/output/points with `ground` and `in_view`."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidar_perception.candidates.segmented_cloud import crop_to_view, diagnose_empty
from lidar_perception.candidates.warm_up import warm_up_ground
from lidar_perception.detectors.normalized_view import NormalizedView, segment_view_ground
from lidar_perception.detectors.pointpillars.config import RANGES
from lidar_perception.ground.segment import segment_ground
from lidar_perception.ground.threshold import compute_inlier_fraction, fit_plane
from lidar_perception.nodes.diagnostics import OK, WARN
from lidar_perception.nodes.inputs import CameraInput
from lidar_perception.nodes.interfaces import CLOUD
from lidar_perception.nodes.managed import ManagedNode
from lidar_perception.nodes.outputs import Obstacles
from lidar_perception.nodes.sensor_check import SensorCheck
from lidar_perception.params import GroundExtraParams, GroundNodeParams
from lidar_perception.runs.compiling import lock_compilation
from lidar_perception.types import PointCloud
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.messages import IN_VIEW, OUT_OF_RANGE, scatter_values
from msg_utils.point_cloud2 import add_columns, from_array, to_array
from msg_utils.stamps import to_ns


class GroundSegmentation(ManagedNode):
    """Ground segmentation by plane fit, Patchwork++ or cloth simulation.

    ~/output/ground, nonground and obstacles are computed only while there are subscribers.
    """

    # Points (M, 3) in the level frame and mask (M,) of the ground, for the diagnostics.
    last_result = np.zeros((0, 3), np.float32), np.zeros(0, bool)

    def __init__(self, **options: Any):
        super().__init__("ground_segmentation", GroundNodeParams(), GroundExtraParams(), **options)

    def configure(self) -> None:
        with lock_compilation(self.get_logger().info):
            warm_up_ground(self.params.ground, self.params.view)
        self.camera = CameraInput(self)
        self.sensor = SensorCheck(self)
        self.points = self.outputs.advertise("points", CLOUD)
        self.ground = self.outputs.advertise("ground", CLOUD)
        self.nonground = self.outputs.advertise("nonground", CLOUD)
        self.obstacles = Obstacles(self)
        self.inputs.subscribe("points", CLOUD, self.on_points, needs=self.camera.find_missing_input)

    def on_points(self, msg: Any) -> None:
        with self.diagnostics.measure_frame(to_ns(msg.header.stamp)):
            frame, cloud_indices, params = self.sensor.read_frame(msg)
            camera = self.camera.get(msg.header, params.view)
            indices, visible_frame = crop_to_view(frame, camera, params.view)
            visible_indices = cloud_indices.take(indices)
            if self.node_params.range == "all":
                segmented_frame, indices = visible_frame, visible_indices
                ground = segment_ground(visible_frame, params.ground)
            else:  # segmented as in the detector, with the same fallback
                view = NormalizedView.of(visible_frame, params.ground.sensor_pose, **RANGES[self.node_params.range])
                segmented_frame, indices = view.frame, visible_indices.take(view.indices)
                ground = segment_view_ground(view.frame, params.ground)
            in_view = scatter_values(OUT_OF_RANGE, visible_indices, msg, "u1")
            in_view[indices] = IN_VIEW
            self.points.publish(
                add_columns(msg, make_bag_message, ground=scatter_values(ground, indices, msg, "u1"), in_view=in_view)
            )
        self._publish_parts(
            msg, visible_frame, visible_indices, params, ground if self.node_params.range == "all" else None
        )
        self.last_result = segmented_frame.xyz, ground
        problem = diagnose_empty(len(frame), ground) or self.sensor.find_problem(frame, params)
        self.diagnostics.report(WARN if problem else OK, problem or "segmenting")

    def values(self) -> dict[str, Any]:
        """Return the lifecycle state, and the plane through the ground of the last cloud."""
        xyz, ground = self.last_result
        plane = fit_plane(xyz.compress(ground, axis=0))
        if plane is None:
            return super().values()
        return {
            **super().values(),
            "plane": " ".join(f"{v:.4f}" for v in plane),
            "plane_inlier_share": f"{compute_inlier_fraction(xyz, plane):.3f}",
            "ground_share": f"{ground.mean():.3f}",
        }

    def _publish_parts(
        self, msg: Any, frame: PointCloud, indices: np.ndarray, params: Any, ground: np.ndarray | None
    ) -> None:
        """Publish ~/output/ground, nonground and obstacles if they have subscribers.

        Args:
            frame: the M visible points of the cloud.
            indices: (M,) indices of these points in the cloud.
            ground: (M,) bool; computed here if it is None.
        """
        parts = self.ground, self.nonground, self.obstacles.publisher
        if not any(publisher.get_subscription_count() for publisher in parts):
            return
        if ground is None:
            ground = segment_ground(frame, params.ground)
        for publisher, mask in ((self.ground, ground), (self.nonground, ~ground)):
            if publisher.get_subscription_count():
                publisher.publish(from_array(to_array(msg).take(indices[mask]), msg.header, make_bag_message))
        self.obstacles.publish(msg, frame.xyz, ground, indices)
