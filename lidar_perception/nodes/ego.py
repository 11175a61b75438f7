"""How the sensor moves, from whatever the parameter ego.source names."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.qos import QoSProfile, ReliabilityPolicy

from lidar_perception.nodes.runtime import CLOUD, LidarNode
from lidar_perception.tracking.ego import Odometry
from lidar_perception.tracking.params import EgoParams
from lidar_perception.tracking.poses import PoseHistory
from lidar_perception.types import InputError
from lidar_perception.wire.messages import pose_of, to_frame
from msg_utils.stamps import to_ns

ODOMETRY = "nav_msgs/msg/Odometry"
MANY = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)  # of a busy node


class EgoInput:
    """Poses of the sensor in a fixed frame, by the stamps of its frames.

    clouds: whether the node itself takes the scans and hands them to pose(); otherwise they come
    from ~/input/points, for kiss_icp alone.
    """

    def __init__(self, node: LidarNode, params: Callable[[], EgoParams], clouds: bool):
        self.node, self.params, self.clouds = node, params, clouds
        self.history = PoseHistory()
        self.child = self.fixed = ""  # the frame whose poses the odometry has, and in which
        self.icp: Odometry | None = None
        self.scan_ns = 0  # of the last scan that KISS-ICP took
        source = params().source
        if source in ("auto", "odometry"):
            node.input("odometry", ODOMETRY, self._on_odometry, MANY)
        elif source == "kiss_icp":
            self.icp = Odometry()
            if not clouds:
                node.input("points", CLOUD, self._on_cloud)

    def pose(self, stamp_ns: int, frame_id: str,
             xyz: np.ndarray | None = None) -> np.ndarray | None:
        """(4, 4) at the stamp of a frame in frame_id; None where it is not known. xyz (N, 3) is its
        scan, where the node takes the clouds."""
        if self.fixed and frame_id == self.fixed:  # detections that are in the fixed frame already
            return np.eye(4)
        if self.icp is not None and self.clouds and xyz is not None:
            self._register(stamp_ns, xyz)
        return self.history.at(stamp_ns, self.params().max_gap)

    def needed(self, stamp_ns: int) -> str | None:
        """What a frame of this stamp should wait for: its pose, where poses come but are a little
        behind."""
        behind = stamp_ns - self.history.newest
        return "the pose of its time" if 0 < behind <= self.params().max_gap * 1e9 else None

    def problem(self, frame_id: str) -> str | None:
        """What is wrong with the poses for frames in frame_id, with the remedy."""
        if self.child and frame_id and frame_id not in (self.child, self.fixed):
            return (f"the odometry is of '{self.child}', the detections of '{frame_id}': they are "
                    "taken to be in one place")
        source = self.params().source
        if not len(self.history) and source in ("odometry", "kiss_icp"):
            topic = "odometry" if source == "odometry" else "points"
            return (f"no pose has come on {self.node.resolve_topic_name(f'~/input/{topic}')} yet: "
                    "tracks are relative to the sensor")
        return None

    def _on_odometry(self, msg: Any) -> None:
        pose = pose_of(msg.pose.pose)
        self.child, self.fixed = msg.child_frame_id, msg.header.frame_id
        self._add(to_ns(msg.header.stamp), pose)

    def _on_cloud(self, msg: Any) -> None:
        self._register(to_ns(msg.header.stamp), to_frame(msg)[0].xyz)

    def _register(self, stamp_ns: int, xyz: np.ndarray) -> None:
        if not len(xyz):
            raise InputError("the cloud has no usable point, so the sensor's motion is not known")
        gap = (stamp_ns - self.scan_ns) / 1e9
        if not 0 < gap <= 2 * self.params().max_gap:  # a map of another place, or of another time
            self.icp, self.history = Odometry(), PoseHistory()
        self.scan_ns = stamp_ns
        self._add(stamp_ns, self.icp(xyz))

    def _add(self, stamp_ns: int, pose: np.ndarray) -> None:
        self.history.add(stamp_ns, pose)
        self.node.counts["last_pose_ns"] = stamp_ns
