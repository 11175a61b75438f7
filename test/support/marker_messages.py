"""MarkerArray messages of detections and tracks."""

from __future__ import annotations

from lidar_perception.wire.messages import make_detection_rows
from lidar_perception.wire.track_markers import make_track_rows
from msg_utils.markers import rows_to_message


def make_detection_markers(detections, header, make, previous=(), lifetime_ns=0, clusters=None):
    return rows_to_message(make_detection_rows(detections, previous, clusters), header, make, lifetime_ns)


def make_track_markers(ids, detections, velocities, moving, trails, header, make, *, lifetime_ns=0, **more):
    rows = make_track_rows(ids, detections, velocities, moving, trails, **more)
    return rows_to_message(rows, header, make, lifetime_ns)
