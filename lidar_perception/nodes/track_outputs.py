"""Tracks of the detections that a node gets or makes, published. The work is the same in both."""

from __future__ import annotations

import importlib.util
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from lidar_perception.nodes.ego import EgoInput
from lidar_perception.nodes.runtime import MARKERS, RELIABLE, LidarNode
from lidar_perception.params import DetectionNodeParams, TrackerNodeParams
from lidar_perception.tracking.ego import NO_SOURCE
from lidar_perception.tracking.state import Tracks
from lidar_perception.tracking.tracker import Tracker
from lidar_perception.tracking.trails import Trails
from lidar_perception.types import CLASSES, Detections
from lidar_perception.wire.codec import bag_message, encode
from lidar_perception.wire.track_markers import make_track_markers
from msg_utils.detections import to_detection_array
from msg_utils.markers import marker_keys
from msg_utils.messages import message_class, ros_message
from msg_utils.stamps import SECOND, header_message, to_ns

DETECTIONS_3D = "vision_msgs/msg/Detection3DArray"
OUTLIVED = 2.5    # periods of the input, for which markers stay at least
LONGEST = 1e6     # seconds; a message has 32 bits for them
RATE_OVER = 10.0  # seconds, over which births and ends are counted as a rate


class TrackOutputs:
    """~/output/tracks, and ~/output/tracks_3d where vision_msgs is installed.

    params: where the node's groups `tracking` and `ego` are; clouds: as EgoInput has it.
    """

    def __init__(self, node: LidarNode,
                 params: Callable[[], DetectionNodeParams | TrackerNodeParams], clouds: bool):
        self.node, self.params = node, params
        self.tracker = Tracker(params().tracking)
        self.ego = EgoInput(node, lambda: params().ego, clouds)
        self.poses_from = NO_SOURCE, True, 0  # of the last frame
        self.trails = Trails()
        self.frame_id: str | None = None
        self.shown: Any = ()
        self.markers = node.output("tracks", MARKERS)
        self.array = node.create_publisher(message_class(DETECTIONS_3D), "~/output/tracks_3d",
                                           RELIABLE) if has_detections_3d() else None
        self.counted: deque[tuple[float, int, int]] = deque()  # seconds, born, ended

    def publish(self, header: Any, detections: Detections,
                xyz: np.ndarray | None = None) -> str | None:
        """Track the detections of one frame, weak ones too, with its scan xyz (N, 3) where the
        node takes the clouds. Returns what was wrong, None if nothing was.

        A frame that is older than the last one, or has its stamp, is not answered: what is known
        is of another time."""
        stamp, tracker = to_ns(header.stamp), self.tracker
        mixed, before = self._same_sensor(header.frame_id), self.poses_from
        pose = self.ego.pose(header, xyz)
        self.poses_from = self.ego.source, self.ego.carried, self.ego.begun
        if before[0] != NO_SOURCE and before != self.poses_from:
            tracker.reset()  # another fixed frame
        problem = mixed or self.ego.problem(header.frame_id, stamp)
        tracker.params = self.params().tracking
        tracks = tracker(detections, stamp, pose)
        if tracker.taken:
            self._send(header, stamp, tracks)
        self._count(stamp, len(tracks))
        return tracker.problem or problem

    def _same_sensor(self, frame_id: str) -> str | None:
        before, self.frame_id = self.frame_id, frame_id
        if before in (None, frame_id):
            return None
        self.tracker.reset()
        return (f"detections of '{before}' and of '{frame_id}' are mixed, and tracks end at every "
                "change; give each sensor a tracker of its own")

    def _send(self, header: Any, stamp: int, tracks: Tracks) -> None:
        output = self.node.robot.output
        trails = self.trails(tracks, self.tracker.pose, stamp, output.trail)
        message = make_track_markers(
            tracks.ids, tracks.detections, tracks.velocities, tracks.moving, trails, header,
            bag_message, previous=self.shown, lifetime_ns=lifetime_ns(self.node),
            extras=[{"seen": bool(seen), "age": round(float(age), 3)}
                    for seen, age in zip(tracks.seen, tracks.ages)])
        self.shown = marker_keys(message)
        self.markers.publish(encode(message))
        if self.array is not None and self.array.get_subscription_count():
            found = tracks.detections
            self.array.publish(to_detection_array(
                found.boxes, [CLASSES[i] for i in found.class_ids], found.scores, ids=tracks.ids,
                covariances=tracks.pose_covariances(), make=ros_message,
                header=header_message(stamp, header.frame_id, ros_message)))

    def _count(self, stamp: int, reported: int) -> None:
        tracker, now = self.tracker, stamp / 1e9
        if self.counted and not 0 <= now - self.counted[-1][0] <= RATE_OVER:
            self.counted.clear()  # time jumped, or there are no stamps
        self.counted.append((now, tracker.born, tracker.ended))
        while now - self.counted[0][0] > RATE_OVER or len(self.counted) > 1000:
            self.counted.popleft()
        before, born, ended = self.counted[0]
        self.node.counts.update(ego=self.ego.source, tracks=reported, alive=tracker.alive,
                                born=tracker.born, ended=tracker.ended)
        if now > before:
            self.node.counts["born_per_s"] = f"{(tracker.born - born) / (now - before):.2f}"
            self.node.counts["ended_per_s"] = f"{(tracker.ended - ended) / (now - before):.2f}"


def lifetime_ns(node: LidarNode) -> int:
    """How long the node's markers stay without newer ones; 0 for ever. Those of a slow sensor stay
    until the next come."""
    seconds = node.robot.output.marker_lifetime
    rates = [rate for made in node._receptions() if (rate := made.expected())]
    if seconds and rates:
        seconds = max(seconds, min(OUTLIVED / min(rates), LONGEST))
    return int(seconds * SECOND)


def has_detections_3d() -> bool:
    """Whether vision_msgs is installed."""
    return importlib.util.find_spec("vision_msgs") is not None
