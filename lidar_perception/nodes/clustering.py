"""Node that clusters obstacles: ~/input/points -> ~/output/points with `cluster_id`."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidar_perception.candidates.segmented_cloud import diagnose_empty, fit_grounded_boxes
from lidar_perception.candidates.warm_up import warm_up_clustering
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.nodes.diagnostics import OK, WARN
from lidar_perception.nodes.interfaces import CLOUD
from lidar_perception.nodes.managed import ManagedNode
from lidar_perception.nodes.outputs import ClusterBoxes
from lidar_perception.params import BoxNodeParams, ClusteringNodeParams
from lidar_perception.runs.compiling import lock_compilation
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.messages import OUT_OF_RANGE, read_column, scatter_values, to_point_cloud
from msg_utils.point_cloud2 import add_columns
from msg_utils.stamps import to_ns


class Clustering(ManagedNode):
    """Distance-aware DBSCAN or adaptive Euclidean clustering of the points that are not ground.

    Boxes are computed only while there are subscribers.
    """

    def __init__(self, **options: Any):
        super().__init__("clustering", ClusteringNodeParams(), BoxNodeParams(), **options)

    def configure(self) -> None:
        with lock_compilation(self.get_logger().info):
            warm_up_clustering(self.params.clustering, self.params.boxes)
        self.points = self.outputs.advertise("points", CLOUD)
        self.boxes = ClusterBoxes(self)
        self.inputs.subscribe("points", CLOUD, self.on_points)

    def on_points(self, msg: Any) -> None:
        with self.diagnostics.measure_frame(to_ns(msg.header.stamp)):
            frame, indices = to_point_cloud(msg)
            in_view = read_column(msg, "in_view", indices)
            if in_view is not None and (in_view == OUT_OF_RANGE).any():
                in_range = np.flatnonzero(in_view != OUT_OF_RANGE)
                frame, indices = frame.take(in_range), indices.take(in_range)
            frame = self.transforms.find_placement(msg.header).level_frame(frame)
            column = read_column(msg, "ground", indices)
            ground = np.zeros(len(frame), bool) if column is None else column > 0
            ids = cluster_obstacles(frame.xyz, ground, self.params.clustering)
            self.points.publish(add_columns(msg, make_bag_message, cluster_id=scatter_values(ids, indices, msg, "u4")))
        self.boxes.publish(msg.header, lambda: fit_grounded_boxes(frame.xyz, ground, ids, self.params.boxes))
        self.diagnostics.counts["clusters"] = int(ids.max(initial=0))
        if column is None:
            self.diagnostics.report(
                WARN,
                "the cloud has no column 'ground', so all points are clustered; "
                "remap ~/input/points to the output of the ground segmentation",
            )
        else:
            problem = diagnose_empty(len(frame), ground, ids)
            self.diagnostics.report(WARN if problem else OK, problem or "clustering")
