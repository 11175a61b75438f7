"""Node that tracks the detections of any detector: ~/input/detections -> ~/output/tracks."""

from __future__ import annotations

from typing import Any

from lidar_perception.classes import DETECTED
from lidar_perception.nodes.diagnostics import OK, WARN
from lidar_perception.nodes.interfaces import DETECTIONS_3D, MARKERS
from lidar_perception.nodes.managed import ManagedNode
from lidar_perception.nodes.track_outputs import TrackOutputs, has_detections_3d
from lidar_perception.params import TrackerExtraParams, TrackerNodeParams
from lidar_perception.types import InputError
from lidar_perception.wire.messages import find_unknown_classes, to_detections
from msg_utils.detections import from_detection_array
from msg_utils.markers import MarkedObjects, find_header, from_marker_array
from msg_utils.stamps import to_ns


class TrackerNode(ManagedNode):
    """Tracks boxes from frame to frame.

    Frames without detections must be sent, too: as an empty Detection3DArray with the header of the
    frame, or as a MarkerArray with a DELETE or DELETEALL marker that has this header.
    """

    def __init__(self, **options: Any):
        super().__init__(
            "tracker", TrackerNodeParams(), TrackerExtraParams(), ("detections", "detections_3d"), **options
        )

    def configure(self) -> None:
        self.tracks = TrackOutputs(self, lambda: self.params, clouds=False)
        self.inputs.subscribe("detections", MARKERS, self.on_markers, needs=self._find_missing_pose)
        if has_detections_3d():
            self.inputs.subscribe(
                "detections_3d",
                DETECTIONS_3D,
                self.on_detections,
                needs=lambda m: self.tracks.ego.find_missing_pose(m.header),
            )

    def _find_missing_pose(self, msg: Any) -> str | None:
        return self.tracks.ego.find_missing_pose(find_header(msg)) if msg.markers else None

    def on_markers(self, msg: Any) -> None:
        if not msg.markers:
            raise InputError(
                "ignored an array without markers, which has no stamp; send a DELETEALL marker with the header of "
                "the frame"
            )
        self._track(find_header(msg), from_marker_array(msg))

    def on_detections(self, msg: Any) -> None:
        self._track(msg.header, from_detection_array(msg))

    def _track(self, header: Any, objects: MarkedObjects) -> None:
        self.diagnostics.frame_id = header.frame_id
        with self.diagnostics.measure_frame(to_ns(header.stamp)):
            problem = self.tracks.publish(header, to_detections(objects))
        problems = [problem] if problem else []
        if unknown_classes := find_unknown_classes(objects.labels):
            problems.append(
                f"detections of the unknown classes {', '.join(unknown_classes)[:80]} are tracked as "
                f"Misc; use {', '.join(DETECTED)} as ns of the markers or as class_id"
            )
        self.diagnostics.report(WARN if problems else OK, "; ".join(problems) or "tracking")
