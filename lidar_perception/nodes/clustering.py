"""~/input/points (with column `ground`) -> ~/output/points, the same with `cluster_id`."""

from __future__ import annotations

from typing import Any

import numpy as np
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from lidar_perception.messages import spread, to_frame
from lidar_perception.nodes.runtime import OK, RELIABLE, WARN, LidarNode
from lidar_perception.params import ClusteringNodeParams
from lidar_perception.pipeline import cluster_obstacles, grounded_boxes, warm_up
from msg_utils.markers import marker_keys, to_marker_array
from msg_utils.messages import ros_message
from msg_utils.point_cloud2 import add_columns, to_array
from msg_utils.stamps import to_ns

__all__ = ["Clustering", "warm_up"]


class Clustering(LidarNode):
    """Distance-aware DBSCAN. Boxes are made only while somebody subscribes."""

    def __init__(self, **options: Any):
        super().__init__("clustering", ClusteringNodeParams(), **options)
        self.points = self.output("points", PointCloud2)
        self.boxes = self.output("boxes", MarkerArray, RELIABLE)
        self.shown: Any = ()
        self.input("points", PointCloud2, self.on_points)

    def on_points(self, msg: Any) -> None:
        with self.frame(to_ns(msg.header.stamp)):
            frame, usable = to_frame(msg)
            ground, in_view = segmentation_columns(msg, usable)
            ids = cluster_obstacles(frame.xyz, in_view & ~ground, self.params.dbscan)
            self.points.publish(add_columns(msg, ros_message,
                                            cluster_id=spread(ids, usable, "u4")))
        if self.boxes.get_subscription_count():
            boxes = grounded_boxes(frame.xyz, ground, ids)
            markers = to_marker_array(boxes, ["cluster"] * len(boxes), header=msg.header,
                                      make=ros_message, previous=self.shown)
            self.shown = marker_keys(markers)
            self.boxes.publish(markers)
        self.counts["clusters"] = int(ids.max(initial=0))
        if "ground" not in to_array(msg).dtype.names:
            self.report(WARN, "the cloud has no column 'ground', so all of it is clustered; "
                        "remap ~/input/points to the ground segmentation's output")
        elif not ids.any():
            self.report(WARN, "no clusters; are dbscan.eps and min_samples right for this sensor?")
        else:
            self.report(OK, "clustering")


def segmentation_columns(msg: Any, usable: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """ground and in_view (N,) bool of the usable points; without the columns nothing is ground
    and everything is in view."""
    points = to_array(msg)
    names = points.dtype.names or ()
    ground = points["ground"][usable] > 0 if "ground" in names else np.zeros(usable.sum(), bool)
    in_view = points["in_view"][usable] > 0 if "in_view" in names else ~np.zeros_like(ground)
    return ground, in_view
