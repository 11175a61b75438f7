"""Node that finds pedestrian candidates in one process: ~/input/points -> ~/output/detections."""

from __future__ import annotations

from typing import Any

from lidar_perception.candidates.params import STEPS, PipelineParams
from lidar_perception.candidates.pipeline import refine_segmented, segment_cloud
from lidar_perception.candidates.seed_sources import SeedSource
from lidar_perception.candidates.segmented_cloud import diagnose_empty
from lidar_perception.candidates.warm_up import warm_up_candidates
from lidar_perception.nodes.inputs import CameraInput, SeedInput
from lidar_perception.nodes.interfaces import CLOUD
from lidar_perception.nodes.managed import ManagedNode
from lidar_perception.nodes.outputs import CandidateOutputs, ClusterBoxes, Obstacles
from lidar_perception.nodes.sensor_check import SensorCheck
from lidar_perception.params import PerceptionExtraParams
from lidar_perception.runs.compiling import lock_compilation
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.messages import scatter_values
from msg_utils.point_cloud2 import add_columns
from msg_utils.stamps import to_ns


class Perception(ManagedNode):
    """Runs all stages of the candidate graph in one node, without copies of clouds between them.

    Parameters and results are the same as in the graph. ~/output/points, boxes and obstacles are
    computed only while there are subscribers.
    """

    def __init__(self, **options: Any):
        super().__init__("perception", PipelineParams(), PerceptionExtraParams(), **options)

    def configure(self) -> None:
        with lock_compilation(self.get_logger().info):
            warm_up_candidates(self.params)
        self.camera = CameraInput(self)
        self.sensor = SensorCheck(self)
        self.results = CandidateOutputs(self, STEPS)
        self.points = self.outputs.advertise("points", CLOUD)
        self.boxes = ClusterBoxes(self)
        self.obstacles = Obstacles(self)
        self.seed = SeedInput(self, self.on_cloud)
        self.inputs.subscribe("points", CLOUD, self.seed.add_cloud, needs=self.camera.find_missing_input)

    def on_cloud(self, msg: Any, source: SeedSource) -> None:
        with self.diagnostics.measure_frame(to_ns(msg.header.stamp)):
            frame, cloud_indices, params = self.sensor.read_frame(
                msg, with_intensity=self.params.seed.source == "automatic"
            )
            segmented_cloud = segment_cloud(frame, self.camera.get(msg.header, params.view), params)
            problem = diagnose_empty(
                len(frame), segmented_cloud.ground, segmented_cloud.cluster_ids
            ) or self.sensor.find_problem(frame, params)
            self.results.publish(
                msg.header, frame.xyz, lambda: refine_segmented(segmented_cloud, source, params), problem
            )
        indices = cloud_indices.take(segmented_cloud.indices)
        if self.points.get_subscription_count():
            self.points.publish(
                add_columns(
                    msg,
                    make_bag_message,
                    ground=scatter_values(segmented_cloud.ground, indices, msg, "u1"),
                    in_view=scatter_values(1, indices, msg, "u1"),
                    cluster_id=scatter_values(segmented_cloud.cluster_ids, indices, msg, "u4"),
                )
            )
        self.boxes.publish(msg.header, lambda: segmented_cloud.boxes)
        self.obstacles.publish(msg, segmented_cloud.xyz, segmented_cloud.ground, indices)
