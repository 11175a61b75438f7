"""~/input/points -> ~/output/points, the same cloud with the columns `ground` and `in_view`."""

from __future__ import annotations

from typing import Any

import numpy as np
from sensor_msgs.msg import PointCloud2

from lidar_perception.ground.threshold import fit_plane
from lidar_perception.messages import spread, to_frame
from lidar_perception.nodes.inputs import CameraInput
from lidar_perception.nodes.runtime import OK, WARN, LidarNode
from lidar_perception.params import GroundNodeParams
from lidar_perception.pipeline import ground_in_view, view_mask, warm_up
from msg_utils.messages import ros_message
from msg_utils.point_cloud2 import add_columns, from_array, to_array
from msg_utils.stamps import to_ns

__all__ = ["GroundSegmentation", "warm_up"]


class GroundSegmentation(LidarNode):
    """Height threshold and RANSAC plane. ~/output/ground and ~/output/nonground are made only
    while somebody subscribes."""

    def __init__(self, **options: Any):
        super().__init__("ground_segmentation", GroundNodeParams(), **options)
        self.camera = CameraInput(self)
        self.points = self.output("points", PointCloud2)
        self.ground = self.output("ground", PointCloud2)
        self.nonground = self.output("nonground", PointCloud2)
        self.input("points", PointCloud2, self.on_points)

    def on_points(self, msg: Any) -> None:
        with self.frame(to_ns(msg.header.stamp)):
            frame, usable = to_frame(msg)
            in_view = view_mask(frame.xyz, self.camera.get(frame.frame_id), self.params)
            ground = ground_in_view(frame.xyz, in_view, self.params.ground)
            column = spread(ground, usable, "u1")
            self.points.publish(add_columns(msg, ros_message, ground=column,
                                            in_view=spread(in_view, usable, "u1")))
        for publisher, wanted in ((self.ground, 1), (self.nonground, 0)):
            if publisher.get_subscription_count():
                chosen = to_array(msg)[(column == wanted) & usable]
                publisher.publish(from_array(chosen, msg.header, ros_message))
        self._diagnose(frame, ground, in_view)

    def _diagnose(self, frame, ground: np.ndarray, in_view: np.ndarray) -> None:
        plane = fit_plane(frame.xyz[ground])
        if len(frame) == 0:
            self.report(WARN, "the cloud is empty or has no finite point")
        elif not in_view.any():
            self.report(WARN, "no point is in the camera's view; check the LiDAR-to-camera "
                        "transform")
        elif plane is None:
            self.report(WARN, f"no ground found below z = {self.params.ground.z_max} m; is the "
                        "sensor's height different? set ground.z_max")
        else:
            self.counts.update(plane=" ".join(f"{v:.4f}" for v in plane),
                               ground_share=f"{ground.sum() / max(in_view.sum(), 1):.3f}")
            self.report(OK, "segmenting")
