"""Tracks as markers: boxes whose ids stay, and for each an arrow, a text and the way it came."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from lidar_perception.types import CLASSES, Detections
from lidar_perception.wire.messages import MAX_ID
from msg_utils.markers import ADD, COLORS, OTHER_COLOR, box_pose, to_marker_array
from msg_utils.stamps import duration_message

ARROW, LINE_STRIP, TEXT = 0, 4, 9
VELOCITY, TRAIL, NUMBER = DRAWN = "velocity", "trail", "number"  # namespaces beside the classes
SHOWN_MOVING = 0.5  # from this probability of motion on there is an arrow


def track_markers(ids: np.ndarray, detections: Detections, velocities: np.ndarray,
                  moving: np.ndarray, trails: Sequence[np.ndarray], header: Any, make: Any, *,
                  extras: Sequence[dict[str, Any]] | None = None,
                  previous: Iterable[tuple[str, int]] = (), lifetime_ns: int = 0) -> Any:
    """MarkerArray of K tracks with ids (K,): the boxes as detection_markers() has them, with the
    id, the velocity (2,) m/s, the probability of motion and extras in the text; and in the
    namespaces DRAWN, with the same ids, where the track will be in a second, its number and speed,
    and its trail (N, 3), from two points on. previous and lifetime_ns as in to_marker_array."""
    ids = np.asarray(ids) % MAX_ID
    labels = [CLASSES[i] for i in detections.class_ids]
    texts = [{"id": int(i), "velocity": [round(float(v), 3) for v in velocity],
              "moving": round(float(p), 3), **(extras[k] if extras is not None else {})}
             for k, (i, velocity, p) in enumerate(zip(ids, velocities, moving))]
    drawn = []
    for i, label, box, velocity, p, trail in zip(ids, labels, detections.boxes.astype(float),
                                                 velocities, moving, trails, strict=True):
        top, moves = box[:3] + [0.0, 0.0, box[5] / 2], p >= SHOWN_MOVING
        speed = f"  {np.hypot(*velocity):.1f} m/s" if moves else ""
        drawn.append(_drawn(make, header, NUMBER, i, label, lifetime_ns, type=TEXT,
                            text=f"{i}{speed}", scale=(0.0, 0.0, 0.6),
                            pose=box_pose(np.append(top + [0.0, 0.0, 0.5], [0.0] * 4), make)))
        if moves:
            ahead = top + [*velocity, 0.0]
            drawn.append(_drawn(make, header, VELOCITY, i, label, lifetime_ns, type=ARROW,
                                points=[top, ahead], scale=(0.1, 0.25, 0.3)))
        if len(trail) > 1:
            drawn.append(_drawn(make, header, TRAIL, i, label, lifetime_ns, type=LINE_STRIP,
                                points=trail, scale=(0.08, 0.0, 0.0)))
    shown = {(m.ns, m.id) for m in drawn}
    gone = [(ns, i) for ns, i in previous if (ns, i) not in shown]
    markers = to_marker_array(detections.boxes, labels, detections.scores, header=header,
                              make=make, ids=ids, extras=texts, previous=gone,
                              lifetime_ns=lifetime_ns)
    markers.markers.extend(drawn)
    return markers


def drawn_trails(msg: Any) -> dict[int, np.ndarray]:
    """id -> trail (N, 3) float64 of the tracks of a MarkerArray that have one."""
    return {int(m.id): np.array([[p.x, p.y, p.z] for p in m.points], np.float64)
            for m in msg.markers if m.ns == TRAIL and m.action == ADD}


def _drawn(make: Any, header: Any, ns: str, number: int, label: str, lifetime_ns: int, *,
           scale: tuple[float, float, float],
           points: Iterable[np.ndarray] = (), **more: Any) -> Any:
    r, g, b = COLORS.get(label, OTHER_COLOR)
    more.setdefault("pose", box_pose(np.zeros(7), make))
    return make("visualization_msgs/msg/Marker", header=header, ns=ns, id=int(number), action=ADD,
                lifetime=duration_message(lifetime_ns, make),
                scale=make("geometry_msgs/msg/Vector3", x=scale[0], y=scale[1], z=scale[2]),
                color=make("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=1.0),
                points=[make("geometry_msgs/msg/Point", x=float(x), y=float(y), z=float(z))
                        for x, y, z in points], **more)
