"""Lossless conversion between labelled boxes and visualization_msgs/MarkerArray.

Each box is a CUBE marker: pose and scale are the box, ns is the label, text is a JSON object with
the score and other fields. An object without a 3D box (KITTI's DontCare) is stored as the text of a
DELETE marker, which is not drawn. Each array deletes the markers of the previous array that it does
not contain, so that no marker becomes stale or flickers. An array without objects has one DELETE
marker that carries the header.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from msg_utils.stamps import make_duration, to_ns

CUBE, ADD, DELETE = 1, 0, 2

COLORS = {  # r g b, from a colour-blind safe palette
    "Car": (0.00, 0.45, 0.70),
    "Van": (0.34, 0.71, 0.91),
    "Truck": (0.00, 0.62, 0.45),
    "Pedestrian": (0.84, 0.37, 0.00),
    "Person_sitting": (0.80, 0.47, 0.65),
    "Cyclist": (0.90, 0.62, 0.00),
    "Tram": (0.95, 0.90, 0.25),
}
OTHER_COLOR = (0.6, 0.6, 0.6)


@dataclass(frozen=True)
class MarkedObjects:
    """Objects of a message.

    Attributes:
        boxes: (K, 7) float64 [x y z l w h yaw].
        labels: K class names.
        scores: (K,) float64.
        ids: (K,) int.
        extras: K JSON objects, including the score if there is one.
        notes: (label, JSON object) of each object without a 3D box.
        stamp_ns: Stamp of the message.
        frame_id: Frame of the message.
    """

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


class MarkerRow(NamedTuple):
    """Fields of a marker that differ between the markers of an array.

    `quaternion` is (z, w) of a rotation about z, `scale` is x, y, z in metres, and `points` is (N,
    3) in metres.
    """

    ns: str
    id: int
    action: int = ADD
    type: int = CUBE
    text: str = ""
    position: Sequence[float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float] = (0.0, 1.0)
    scale: Sequence[float] = (0.0, 0.0, 0.0)
    color: tuple[float, float, float, float] = (*OTHER_COLOR, 0.4)
    points: np.ndarray | None = None


class MarkerRows(NamedTuple):
    """MarkerArray as rows with a common header; functions of this module accept it as a message."""

    rows: Sequence[MarkerRow]
    header: Any
    lifetime_ns: int = 0

    @property
    def markers(self) -> Sequence[MarkerRow]:
        return self.rows


def make_marker_rows(
    boxes: np.ndarray,
    labels: Sequence[str],
    scores: Sequence[float] | np.ndarray | None = None,
    *,
    ids: Sequence[int] | np.ndarray | None = None,
    extras: Sequence[dict[str, Any]] | None = None,
    notes: Iterable[tuple[str, dict[str, Any]]] = (),
    previous: Iterable[tuple[str, int]] = (),
    color: tuple[float, float, float] | None = None,
) -> list[MarkerRow]:
    """Make the markers of K boxes; for the arguments see to_marker_array."""
    rows, added_keys = [], set()
    box_rows = np.asarray(boxes, np.float64).reshape(-1, 7).tolist()
    ids = range(len(box_rows)) if ids is None else ids
    for i, (box, label, marker_id) in enumerate(zip(box_rows, labels, map(int, ids), strict=True)):
        content = dict(extras[i]) if extras is not None else {}
        if scores is not None:
            content["score"] = float(scores[i])
        half_yaw = box[6] / 2
        rows.append(
            MarkerRow(
                label,
                marker_id,
                ADD,
                CUBE,
                json.dumps(content) if content else "",
                box[:3],
                (math.sin(half_yaw), math.cos(half_yaw)),
                box[3:6],
                (*(color or COLORS.get(label, OTHER_COLOR)), 0.4),
            )
        )
        added_keys.add((label, marker_id))
    rows += [MarkerRow(label, -1 - i, DELETE, text=json.dumps(content)) for i, (label, content) in enumerate(notes)]
    rows += [MarkerRow(label, marker_id, DELETE) for label, marker_id in sorted(set(previous) - added_keys)]
    return rows or [MarkerRow("", 0, DELETE)]


def to_marker_array(
    boxes: np.ndarray,
    labels: Sequence[str],
    scores: Sequence[float] | np.ndarray | None = None,
    *,
    header: Any,
    make: Any,
    lifetime_ns: int = 0,
    **more: Any,
) -> Any:
    """Build a MarkerArray of K boxes.

    Args:
        boxes: (K, 7) [x y z l w h yaw].
        labels: K class names, used as namespaces.
        scores: K scores, or None.
        header: Header of all markers.
        make: Function that creates messages, see msg_utils.
        lifetime_ns: Lifetime of the markers, 0 for no limit.
        ids: K ids, by default 0..K-1.
        extras: K dicts for the texts.
        notes: (label, content) of each object without a 3D box.
        previous: Result of list_marker_keys() for the previous array.
        color: (r, g, b) that replaces the colours of the labels.
    """
    return rows_to_message(make_marker_rows(boxes, labels, scores, **more), header, make, lifetime_ns)


def rows_to_message(rows: Iterable[MarkerRow], header: Any, make: Any, lifetime_ns: int = 0) -> Any:
    """Build a MarkerArray from rows."""

    def make_vector(type_name: str, numbers: Sequence[float]) -> Any:
        x, y, z = map(float, numbers)
        return make(f"geometry_msgs/msg/{type_name}", x=x, y=y, z=z)

    lifetime, markers = make_duration(lifetime_ns, make), []
    for row in rows:
        (z, w), (r, g, b, a) = row.quaternion, row.color
        orientation = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=z, w=w)
        points = [] if row.points is None else [make_vector("Point", point) for point in row.points]
        markers.append(
            make(
                "visualization_msgs/msg/Marker",
                header=header,
                ns=row.ns,
                id=row.id,
                type=row.type,
                action=row.action,
                lifetime=lifetime,
                text=row.text,
                points=points,
                pose=make(
                    "geometry_msgs/msg/Pose", position=make_vector("Point", row.position), orientation=orientation
                ),
                scale=make_vector("Vector3", row.scale),
                color=make("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=a),
            )
        )
    return make("visualization_msgs/msg/MarkerArray", markers=markers)


def from_marker_array(msg: Any) -> MarkedObjects:
    """Convert the CUBE markers of a MarkerArray (message or MarkerRows) of any node to objects."""
    cubes = [m for m in msg.markers if m.action == ADD and m.type == CUBE]
    extras = [_parse_text(m.text) for m in cubes]
    scores = [_read_score(content) for content in extras]
    boxes = np.array([_read_box(m) for m in cubes], np.float64).reshape(-1, 7)
    notes = [(m.ns, _parse_text(m.text)) for m in msg.markers if m.action == DELETE and m.text]
    header = find_header(msg)
    return MarkedObjects(
        boxes,
        [m.ns for m in cubes],
        np.array(scores, np.float64),
        np.array([m.id for m in cubes], int),
        extras,
        notes,
        to_ns(header.stamp) if header else 0,
        header.frame_id if header else "",
    )


def find_header(msg: Any) -> Any | None:
    """Return the header of a MarkerArray, None if it is empty.

    It is taken from the first CUBE marker if there is one, otherwise from the first marker, because
    a DELETEALL marker may have no header.
    """
    if isinstance(msg, MarkerRows):
        return msg.header
    cubes = (m for m in msg.markers if m.action == ADD and m.type == CUBE)
    first_marker = next(cubes, next(iter(msg.markers), None))
    return None if first_marker is None else first_marker.header


def list_marker_keys(array: Any) -> frozenset[tuple[str, int]]:
    """Return (ns, id) of each ADD marker.

    Args:
        array: A MarkerArray, or a list of MarkerRow.

    Pass the result as `previous` when you build the next array.
    """
    return frozenset((m.ns, int(m.id)) for m in getattr(array, "markers", array) if m.action == ADD)


def make_box_pose(box: np.ndarray, make: Any) -> Any:
    """Build the geometry_msgs/Pose of a box (7,) from its centre and yaw."""
    half_yaw = float(box[6]) / 2
    return make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=float(box[0]), y=float(box[1]), z=float(box[2])),
        orientation=make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(half_yaw), w=math.cos(half_yaw)),
    )


def compute_yaw(pose: Any) -> float:
    """Compute the yaw angle of a geometry_msgs/Pose, in radians."""
    q = pose.orientation
    return math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))


def _read_box(m: Any) -> list[float]:
    if isinstance(m, MarkerRow):
        z, w = m.quaternion
        return [*m.position, *m.scale, math.atan2(2 * (w * z), 1 - 2 * (z * z))]
    p, s = m.pose.position, m.scale
    return [p.x, p.y, p.z, s.x, s.y, s.z, compute_yaw(m.pose)]


def _read_score(content: dict[str, Any]) -> float:
    """Return the score; 1 if it is missing or not a number in the range of float64."""
    score = content.get("score")
    try:
        return float(score) if isinstance(score, int | float) else 1.0
    except OverflowError:
        return 1.0


def _parse_text(text: str) -> dict[str, Any]:
    try:
        content = json.loads(text) if text else {}
    except (ValueError, RecursionError):  # raised if the text is not JSON or is nested too deeply
        return {"text": text}
    return content if isinstance(content, dict) else {"text": text}
