"""The whole pipeline in one process: ~/input/points -> ~/output/detections."""

from __future__ import annotations

from typing import Any

from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from lidar_perception.candidates.refine import Candidates
from lidar_perception.messages import spread, to_frame
from lidar_perception.nodes.inputs import CameraInput, SeedInput
from lidar_perception.nodes.outputs import CandidateOutputs
from lidar_perception.nodes.runtime import RELIABLE, LidarNode
from lidar_perception.params import PipelineParams
from lidar_perception.pipeline import SeedSource, Segmented, refined, segment, warm_up
from msg_utils.markers import marker_keys, to_marker_array
from msg_utils.messages import ros_message
from msg_utils.point_cloud2 import add_columns
from msg_utils.stamps import to_ns

__all__ = ["Perception", "warm_up"]


class Perception(LidarNode):
    """Same stages, parameters and results as the graph of single nodes, without the copies
    between them. ~/output/points and ~/output/boxes are made only while somebody subscribes."""

    def __init__(self, **options: Any):
        super().__init__("perception", PipelineParams(), **options)
        self.camera = CameraInput(self)
        self.outputs = CandidateOutputs(self)
        self.points = self.output("points", PointCloud2)
        self.boxes = self.output("boxes", MarkerArray, RELIABLE)
        self.shown: Any = ()
        self.seed = SeedInput(self, self.on_cloud)
        self.input("points", PointCloud2, self.seed.add_cloud)

    def on_cloud(self, msg: Any, source: SeedSource) -> None:
        with self.frame(to_ns(msg.header.stamp)):
            frame, usable = to_frame(msg)
            segmented = segment(frame, self.camera.get(frame.frame_id), self.params)

            def find() -> Candidates:
                return refined(frame, segmented, source, self.params)

            self.outputs.publish(msg.header, find)
        self._publish_clusters(msg, segmented, usable)

    def _publish_clusters(self, msg: Any, segmented: Segmented, usable: Any) -> None:
        if self.points.get_subscription_count():
            self.points.publish(add_columns(
                msg, ros_message, ground=spread(segmented.ground, usable, "u1"),
                in_view=spread(segmented.in_view, usable, "u1"),
                cluster_id=spread(segmented.cluster_ids, usable, "u4")))
        if self.boxes.get_subscription_count():
            markers = to_marker_array(segmented.boxes, ["cluster"] * len(segmented.boxes),
                                      header=msg.header, make=ros_message, previous=self.shown)
            self.shown = marker_keys(markers)
            self.boxes.publish(markers)

    def time_went_back(self) -> None:
        self.seed.clear()
