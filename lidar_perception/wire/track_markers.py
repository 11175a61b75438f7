"""Tracks as markers: boxes with stable ids, velocity arrows, labels and trails."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from lidar_perception.types import CLASSES, Detections
from lidar_perception.wire.messages import MAX_ID
from msg_utils.markers import ADD, COLORS, OTHER_COLOR, make_box_pose, to_marker_array
from msg_utils.stamps import make_duration

ARROW, LINE_STRIP, TEXT = 0, 4, 9
# Namespaces in addition to those named after the classes.
VELOCITY, TRAIL, NUMBER = EXTRA_NAMESPACES = "velocity", "trail", "number"
MIN_ARROW_PROBABILITY = 0.5  # of motion; a track with less has no velocity arrow


def make_track_markers(ids: np.ndarray, detections: Detections, velocities: np.ndarray,
                       moving: np.ndarray, trails: Sequence[np.ndarray], header: Any, make: Any, *,
                       extras: Sequence[dict[str, Any]] | None = None,
                       previous: Iterable[tuple[str, int]] = (), lifetime_ns: int = 0) -> Any:
    """Make the MarkerArray of K tracks.

    Boxes are as in make_detection_markers; their text also has the velocity (m/s), the probability
    of motion and the extras. In EXTRA_NAMESPACES, with the same ids: an arrow to the position in
    one second, a label with number and speed, and the trail.

    Args:
        ids: (K,) track ids.
        velocities: (K, 2) m/s.
        moving: (K,) probabilities of motion.
        trails: K arrays (N, 3) of past positions; drawn from two points on.
        extras: K dicts that are added to the texts of the boxes.
        previous, lifetime_ns: as in to_marker_array.
    """
    ids = np.asarray(ids) % MAX_ID
    labels = [CLASSES[i] for i in detections.class_ids]
    texts = [{"id": int(i), "velocity": [round(float(v), 3) for v in velocity],
              "moving": round(float(p), 3), **(extras[k] if extras is not None else {})}
             for k, (i, velocity, p) in enumerate(zip(ids, velocities, moving))]
    extra_markers = []
    for i, label, box, velocity, p, trail in zip(ids, labels, detections.boxes.astype(float),
                                                 velocities, moving, trails, strict=True):
        top, has_arrow = box[:3] + [0.0, 0.0, box[5] / 2], p >= MIN_ARROW_PROBABILITY
        speed = f"  {np.hypot(*velocity):.1f} m/s" if has_arrow else ""
        extra_markers.append(_make_marker(make, header, NUMBER, i, label, lifetime_ns, type=TEXT,
                                          text=f"{i}{speed}", scale=(0.0, 0.0, 0.6),
                                          pose=make_box_pose(
                                              np.append(top + [0.0, 0.0, 0.5], [0.0] * 4), make)))
        if has_arrow:
            ahead = top + [*velocity, 0.0]
            extra_markers.append(_make_marker(make, header, VELOCITY, i, label, lifetime_ns,
                                              type=ARROW, points=[top, ahead],
                                              scale=(0.1, 0.25, 0.3)))
        if len(trail) > 1:
            extra_markers.append(_make_marker(make, header, TRAIL, i, label, lifetime_ns,
                                              type=LINE_STRIP, points=trail,
                                              scale=(0.08, 0.0, 0.0)))
    shown = {(m.ns, m.id) for m in extra_markers}
    removed = [(ns, i) for ns, i in previous if (ns, i) not in shown]
    markers = to_marker_array(detections.boxes, labels, detections.scores, header=header,
                              make=make, ids=ids, extras=texts, previous=removed,
                              lifetime_ns=lifetime_ns)
    markers.markers.extend(extra_markers)
    return markers


def read_trails(msg: Any) -> dict[int, np.ndarray]:
    """Return the trails (N, 3) float64 in a MarkerArray, by track id."""
    return {int(m.id): np.array([[p.x, p.y, p.z] for p in m.points], np.float64)
            for m in msg.markers if m.ns == TRAIL and m.action == ADD}


def _make_marker(make: Any, header: Any, ns: str, number: int, label: str, lifetime_ns: int, *,
                 scale: tuple[float, float, float],
                 points: Iterable[np.ndarray] = (), **more: Any) -> Any:
    r, g, b = COLORS.get(label, OTHER_COLOR)
    more.setdefault("pose", make_box_pose(np.zeros(7), make))
    return make("visualization_msgs/msg/Marker", header=header, ns=ns, id=int(number), action=ADD,
                lifetime=make_duration(lifetime_ns, make),
                scale=make("geometry_msgs/msg/Vector3", x=scale[0], y=scale[1], z=scale[2]),
                color=make("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=1.0),
                points=[make("geometry_msgs/msg/Point", x=float(x), y=float(y), z=float(z))
                        for x, y, z in points], **more)
