"""Labelled boxes <-> visualization_msgs/MarkerArray, exact inverses of each other.

One CUBE marker a box: pose and scale are the box, ns is the label, text is a JSON object with
the score and whatever else the box carries. An object without a 3D box (KITTI's DontCare)
travels as the text of a DELETE marker, which draws nothing. Each array deletes what the previous
one showed and this one does not, so nothing stale stays and nothing flickers. An array without
objects still holds one DELETE marker: its header says which frame was empty.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from msg_utils.stamps import duration_message, to_ns

CUBE, ADD, DELETE = 1, 0, 2

COLORS = {  # r g b; from a palette that colour-blind readers can tell apart
    "Car": (0.00, 0.45, 0.70), "Van": (0.34, 0.71, 0.91), "Truck": (0.00, 0.62, 0.45),
    "Pedestrian": (0.84, 0.37, 0.00), "Person_sitting": (0.80, 0.47, 0.65),
    "Cyclist": (0.90, 0.62, 0.00), "Tram": (0.95, 0.90, 0.25),
}
OTHER_COLOR = (0.6, 0.6, 0.6)


@dataclass(frozen=True)
class MarkedObjects:
    """boxes (K, 7) float64 [x y z l w h yaw], scores (K,) float64, ids (K,) the markers' ids,
    labels K strings, extras K JSON objects (the score among them where there is one); notes are
    (label, JSON object) without a 3D box."""

    boxes: np.ndarray
    labels: list[str]
    scores: np.ndarray
    ids: np.ndarray
    extras: list[dict[str, Any]]
    notes: list[tuple[str, dict[str, Any]]] = field(default_factory=list)
    stamp_ns: int = 0
    frame_id: str = ""

    def __len__(self) -> int:
        return len(self.boxes)


def to_marker_array(boxes: np.ndarray, labels: Sequence[str],
                    scores: Sequence[float] | np.ndarray | None = None, *, header: Any, make: Any,
                    ids: Sequence[int] | np.ndarray | None = None,
                    extras: Sequence[dict[str, Any]] | None = None,
                    notes: Iterable[tuple[str, dict[str, Any]]] = (),
                    previous: Iterable[tuple[str, int]] = (),
                    color: tuple[float, float, float] | None = None,
                    lifetime_ns: int = 0) -> Any:
    """MarkerArray of K boxes. ids default to 0..K-1; previous is marker_keys() of the array
    before this one; color (r, g, b) overrides the label's; lifetime 0 means for ever."""
    boxes = np.asarray(boxes, np.float64).reshape(-1, 7)
    ids = range(len(boxes)) if ids is None else ids
    lifetime = duration_message(lifetime_ns, make)
    empty = box_pose(np.zeros(7), make)  # with a unit quaternion

    def marker(ns: str, index: int, action: int, text: str, pose: Any = empty,
               scale: Iterable[float] = (0, 0, 0),
               rgb: tuple[float, float, float] = OTHER_COLOR) -> Any:
        x, y, z = map(float, scale)
        r, g, b = rgb
        return make("visualization_msgs/msg/Marker", header=header, ns=ns, id=int(index),
                    type=CUBE, action=action, pose=pose, lifetime=lifetime, text=text,
                    scale=make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
                    color=make("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=0.4))

    markers, shown = [], set()
    for i, (box, label, index) in enumerate(zip(boxes, labels, ids, strict=True)):
        content = dict(extras[i]) if extras is not None else {}
        if scores is not None:
            content["score"] = float(scores[i])
        markers.append(marker(label, index, ADD, json.dumps(content) if content else "",
                              box_pose(box, make), box[3:6],
                              color or COLORS.get(label, OTHER_COLOR)))
        shown.add((label, int(index)))
    for i, (label, content) in enumerate(notes):
        markers.append(marker(label, -1 - i, DELETE, json.dumps(content)))
    for label, index in sorted(set(previous) - shown):
        markers.append(marker(label, index, DELETE, ""))
    if not markers:
        markers.append(marker("", 0, DELETE, ""))
    return make("visualization_msgs/msg/MarkerArray", markers=markers)


def from_marker_array(msg: Any) -> MarkedObjects:
    """The objects of a MarkerArray, from this module or any other node that sends CUBEs."""
    cubes = [m for m in msg.markers if m.action == ADD and m.type == CUBE]
    extras = [_content(m.text) for m in cubes]
    scores = [_score(content) for content in extras]
    boxes = np.array([_box(m) for m in cubes], np.float64).reshape(-1, 7)
    notes = [(m.ns, _content(m.text)) for m in msg.markers if m.action == DELETE and m.text]
    header = array_header(msg)
    return MarkedObjects(boxes, [m.ns for m in cubes], np.array(scores, np.float64),
                         np.array([m.id for m in cubes], int), extras, notes,
                         to_ns(header.stamp) if header else 0, header.frame_id if header else "")


def array_header(msg: Any) -> Any | None:
    """The header of a MarkerArray: that of the first CUBE, as a DELETEALL before it may have none;
    of the first marker where there is no CUBE, and None without markers."""
    cubes = (m for m in msg.markers if m.action == ADD and m.type == CUBE)
    found = next(cubes, next(iter(msg.markers), None))
    return None if found is None else found.header


def marker_keys(msg: Any) -> frozenset[tuple[str, int]]:
    """What a MarkerArray shows, as (ns, id): give it as `previous` to the next array."""
    return frozenset((m.ns, int(m.id)) for m in msg.markers if m.action == ADD)


def box_pose(box: np.ndarray, make: Any) -> Any:
    """geometry_msgs/Pose of the centre and yaw of a box (7,)."""
    half = float(box[6]) / 2
    return make("geometry_msgs/msg/Pose",
                position=make("geometry_msgs/msg/Point", x=float(box[0]), y=float(box[1]),
                              z=float(box[2])),
                orientation=make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(half),
                                 w=math.cos(half)))


def pose_yaw(pose: Any) -> float:
    """Rotation about z of a geometry_msgs/Pose, radians."""
    q = pose.orientation
    return math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))


def _box(m: Any) -> list[float]:
    p, s = m.pose.position, m.scale
    return [p.x, p.y, p.z, s.x, s.y, s.z, pose_yaw(m.pose)]


def _score(content: dict[str, Any]) -> float:
    """The score in it; 1 without one, and for what is no number that float64 holds."""
    score = content.get("score")
    try:
        return float(score) if isinstance(score, int | float) else 1.0
    except OverflowError:
        return 1.0


def _content(text: str) -> dict[str, Any]:
    try:
        content = json.loads(text) if text else {}
    except (ValueError, RecursionError):  # no JSON, or brackets and digits without end
        return {"text": text}
    return content if isinstance(content, dict) else {"text": text}
