"""~/input/points (with `ground` and `cluster_id`) -> ~/output/detections, pedestrian candidates."""

from __future__ import annotations

from typing import Any

import numpy as np
from sensor_msgs.msg import PointCloud2

from lidar_perception.messages import to_frame
from lidar_perception.nodes.clustering import segmentation_columns
from lidar_perception.nodes.inputs import SeedInput
from lidar_perception.nodes.outputs import CandidateOutputs
from lidar_perception.nodes.runtime import LidarNode
from lidar_perception.params import RefinementNodeParams
from lidar_perception.pipeline import SeedSource, Segmented, grounded_boxes, refined, warm_up
from lidar_perception.types import InputError
from msg_utils.point_cloud2 import to_array
from msg_utils.stamps import to_ns

__all__ = ["CandidateRefinement", "warm_up"]


class CandidateRefinement(LidarNode):
    """Ground snapping, height filter, STM and CPA."""

    def __init__(self, **options: Any):
        super().__init__("candidate_refinement", RefinementNodeParams(), **options)
        self.outputs = CandidateOutputs(self)
        self.seed = SeedInput(self, self.on_cloud)
        self.input("points", PointCloud2, self.seed.add_cloud)

    def on_cloud(self, msg: Any, source: SeedSource) -> None:
        with self.frame(to_ns(msg.header.stamp)):
            frame, usable = to_frame(msg)
            ground, in_view = segmentation_columns(msg, usable)
            points = to_array(msg)
            if "cluster_id" not in (points.dtype.names or ()):
                raise InputError("the cloud has no column 'cluster_id'; remap ~/input/points to "
                                 "the clustering's output")
            ids = points["cluster_id"][usable].astype(np.int32)
            boxes = grounded_boxes(frame.xyz, ground, ids)
            segmented = Segmented(in_view, ground, ids, boxes, {})
            self.outputs.publish(msg.header, lambda: refined(
                frame, segmented, source, self.params))

    def time_went_back(self) -> None:
        self.seed.clear()
