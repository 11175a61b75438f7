"""Tracking of detections and publication of tracks, for the tracker and the detector nodes."""

from __future__ import annotations

import importlib.util
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from lidar_perception.nodes.ego import EgoInput
from lidar_perception.nodes.interfaces import DETECTIONS_3D, MARKERS, RELIABLE
from lidar_perception.nodes.runtime import LidarNode
from lidar_perception.params import DetectionNodeParams, TrackerNodeParams
from lidar_perception.runs.compiling import lock_compilation
from lidar_perception.tracking.ego import NO_SOURCE
from lidar_perception.tracking.state import Tracks
from lidar_perception.tracking.tracker import Tracker, warm_up
from lidar_perception.tracking.trails import Trails
from lidar_perception.types import Detections
from lidar_perception.wire.array_codec import encode_detection_array
from lidar_perception.wire.track_markers import make_track_rows
from msg_utils.markers import MarkerRow, MarkerRows, list_marker_keys
from msg_utils.messages import load_message_class
from msg_utils.stamps import SECOND_NS, to_ns

MIN_LIFETIME_PERIODS = 2.5  # minimum lifetime of markers, in periods of the input
MAX_LIFETIME_S = 1e6  # upper limit of that minimum; a Duration message has 32-bit seconds
RATE_WINDOW_S = 10.0  # averaging window for the rates of new and ended tracks


class MarkerOutput:
    """Publisher of markers. Each array deletes those markers of the previous one that it does not contain."""

    def __init__(self, node: LidarNode, topic: str):
        self.node, self.publisher = node, node.outputs.advertise(topic, MARKERS)
        self.keys: frozenset[tuple[str, int]] = frozenset()  # keys of the markers in the last array

    def publish(self, header: Any, make_rows: Callable[[frozenset[tuple[str, int]]], list[MarkerRow]]) -> None:
        """Publish the markers that make_rows(keys of the previous array) returns."""
        rows = make_rows(self.keys)
        self.keys = list_marker_keys(rows)
        self.publisher.publish(MarkerRows(rows, header, find_marker_lifetime_ns(self.node)))


class TrackOutputs:
    """Tracker with publishers of ~/output/tracks, and of tracks_3d if vision_msgs is installed.

    Args:
        node: the node that publishes.
        params: returns the current parameters, with the groups tracking and ego.
        clouds: True if the node subscribes to clouds, see EgoInput.
    """

    def __init__(self, node: LidarNode, params: Callable[[], DetectionNodeParams | TrackerNodeParams], clouds: bool):
        self.node, self.params = node, params
        with lock_compilation(node.get_logger().info):
            warm_up()
        self.tracker = Tracker(params().tracking)
        self.ego = EgoInput(node, lambda: params().ego, clouds)
        # Source, is_mounting_known and icp_restarts of the poses for the last frame.
        self.pose_source = NO_SOURCE, True, 0
        self.trails = Trails()
        self.frame_id: str | None = None
        self.markers = MarkerOutput(node, "tracks")
        self.array = (
            node.create_publisher(load_message_class(DETECTIONS_3D), "~/output/tracks_3d", RELIABLE)
            if has_detections_3d()
            else None
        )
        self.count_history: deque[tuple[float, int, int]] = deque()  # (time in seconds, tracks started, tracks ended)

    def publish(self, header: Any, detections: Detections, xyz: np.ndarray | None = None) -> str | None:
        """Track the detections of one frame and publish the tracks.

        Nothing is published for a frame that is not newer than the last one.

        Args:
            header: header of the frame.
            detections: all detections, including those with low scores.
            xyz: (N, 3) scan of the frame, if the node subscribes to clouds.

        Returns:
            The problem of the frame with its remedy, or None.
        """
        stamp, tracker = to_ns(header.stamp), self.tracker
        sensor_problem, previous_source = self._check_sensor(header.frame_id), self.pose_source
        pose = self.ego.find_pose(header, xyz)
        self.pose_source = self.ego.source, self.ego.is_mounting_known, self.ego.icp_restarts
        if previous_source[0] != NO_SOURCE and previous_source != self.pose_source:
            tracker.reset()  # the fixed frame has changed
        problem = sensor_problem or self.ego.find_problem(header.frame_id, stamp)
        tracker.params = self.params().tracking
        tracks = tracker(detections, stamp, pose)
        if tracker.frame_used:
            self._send(header, stamp, tracks)
        self._update_counts(stamp, len(tracks))
        return tracker.problem or problem

    def _check_sensor(self, frame_id: str) -> str | None:
        previous, self.frame_id = self.frame_id, frame_id
        if previous in (None, frame_id):
            return None
        self.tracker.reset()
        return (
            f"detections in the frames '{previous}' and '{frame_id}' are mixed, so tracks end at every change; "
            "start one tracker for each sensor"
        )

    def _send(self, header: Any, stamp: int, tracks: Tracks) -> None:
        trails = self.trails(tracks, self.tracker.pose, stamp, self.node.node_params.output.trail)
        texts = [{"seen": bool(seen), "age": round(float(age), 3)} for seen, age in zip(tracks.seen, tracks.ages)]
        self.markers.publish(
            header,
            lambda previous: make_track_rows(
                tracks.ids, tracks.detections, tracks.velocities, tracks.moving, trails, previous=previous, extras=texts
            ),
        )
        if self.array is not None and self.array.get_subscription_count():
            detections = tracks.detections
            self.array.publish(
                encode_detection_array(
                    detections.boxes,
                    detections.labels,
                    detections.scores,
                    header=header,
                    ids=tracks.ids,
                    covariances=tracks.to_pose_covariances(),
                )
            )

    def _update_counts(self, stamp: int, track_count: int) -> None:
        tracker, now = self.tracker, stamp / 1e9
        if self.count_history and not 0 <= now - self.count_history[-1][0] <= RATE_WINDOW_S:
            self.count_history.clear()  # time has jumped, or the frames have no stamps
        self.count_history.append((now, tracker.started_count, tracker.ended_count))
        while now - self.count_history[0][0] > RATE_WINDOW_S or len(self.count_history) > 1000:
            self.count_history.popleft()
        begin, started_count, ended_count = self.count_history[0]
        counts = self.node.diagnostics.counts
        counts.update(ego=self.ego.source, tracks=track_count, alive=tracker.alive_count)
        counts.update(born=tracker.started_count, ended=tracker.ended_count)
        if now > begin:
            counts["born_per_s"] = f"{(tracker.started_count - started_count) / (now - begin):.2f}"
            counts["ended_per_s"] = f"{(tracker.ended_count - ended_count) / (now - begin):.2f}"


def find_marker_lifetime_ns(node: LidarNode) -> int:
    """Return the lifetime of the markers of a node in ns, 0 for unlimited.

    It is at least MIN_LIFETIME_PERIODS periods of the input, so that the markers of slow sensors do
    not flicker.
    """
    seconds = node.node_params.output.marker_lifetime
    rates = [rate for reception in node.inputs.receptions if (rate := reception.get_expected_rate())]
    if seconds and rates:
        seconds = max(seconds, min(MIN_LIFETIME_PERIODS / min(rates), MAX_LIFETIME_S))
    return int(seconds * SECOND_NS)


def has_detections_3d() -> bool:
    """Return True if vision_msgs is installed."""
    return importlib.util.find_spec("vision_msgs") is not None
