"""~/input/detections of any detector -> ~/output/tracks: ids, velocities, and steadier boxes."""

from __future__ import annotations

from typing import Any

from lidar_perception.classes import DETECTED
from lidar_perception.nodes.managed import ManagedNode
from lidar_perception.nodes.runtime import MARKERS, OK, WARN
from lidar_perception.nodes.track_outputs import DETECTIONS_3D, TrackOutputs, has_detections_3d
from lidar_perception.params import TrackerNodeParams, TrackInputParams
from lidar_perception.types import InputError
from lidar_perception.wire.messages import find_unknown_classes, to_detections
from msg_utils.detections import from_detection_array
from msg_utils.markers import MarkedObjects, array_header, from_marker_array
from msg_utils.stamps import to_ns


class TrackerNode(ManagedNode):
    """A frame without detections is an array that says when it was: of markers a DELETE or
    DELETEALL with its header."""

    waits_for = "detections", "detections_3d"

    def __init__(self, **options: Any):
        super().__init__("tracker", TrackerNodeParams(), TrackInputParams(), **options)

    def configure(self) -> None:
        self.tracks = TrackOutputs(self, lambda: self.params, clouds=False)
        self.input("detections", MARKERS, self.on_markers,
                   needs=lambda m: self.tracks.ego.needed(array_header(m)) if m.markers else None)
        if has_detections_3d():
            self.input("detections_3d", DETECTIONS_3D, self.on_detections,
                       needs=lambda m: self.tracks.ego.needed(m.header))

    def on_markers(self, msg: Any) -> None:
        if not msg.markers:
            raise InputError("an array without a marker does not say of when it is; send a "
                             "DELETEALL with the header of the frame. It is left out")
        self._track(array_header(msg), from_marker_array(msg))

    def on_detections(self, msg: Any) -> None:
        self._track(msg.header, from_detection_array(msg))

    def _track(self, header: Any, objects: MarkedObjects) -> None:
        self.frame_id = header.frame_id
        with self.frame(to_ns(header.stamp)):
            problem = self.tracks.publish(header, to_detections(objects))
        said = [problem] if problem else []
        if unknown := find_unknown_classes(objects.labels):
            said.append(f"detections of the classes {', '.join(unknown)[:80]} are tracked as Misc: "
                        f"call them {', '.join(DETECTED)} in markers' ns or in class_id")
        self.report(WARN if said else OK, "; ".join(said) or "tracking")
