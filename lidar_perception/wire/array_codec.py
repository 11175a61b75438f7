"""CDR of arrays of boxes and markers, encoded without message objects, ten times as fast.

The bytes are equal to rclpy's for the same messages, but padding, which it leaves undefined, is 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from struct import Struct
from typing import Any

import numpy as np

from msg_utils.markers import MarkerRow
from msg_utils.stamps import SECOND_NS

ENCAPSULATION = b"\0\1\0\0"  # CDR, little-endian; alignment counts from its end
STAMP, LENGTH, BODY = Struct("<iI"), Struct("<I"), Struct("<10d4fiI?")
IDS, NUMBER, POSE, SIZE = Struct("<3i"), Struct("<d"), Struct("<7d"), Struct("<3d")
EMPTY_STRING = LENGTH.pack(1) + bytes(4)  # length 1, then a zero byte and padding
# No colors, texture resource, texture (stamp, frame, format, data) and uv coordinates.
NO_TEXTURE = LENGTH.pack(0) + EMPTY_STRING + STAMP.pack(0, 0) + 2 * EMPTY_STRING + bytes(8)
# No mesh resource, no mesh file (name, data), mesh_use_embedded_materials is False.
NO_MESH = 2 * EMPTY_STRING + LENGTH.pack(0) + b"\0"


def encode_markers(rows: Sequence[MarkerRow], header: Any, lifetime_ns: int = 0) -> bytes:
    """Return the CDR of the visualization_msgs/MarkerArray of rows.

    Args:
        header: message with `stamp` and `frame_id`.
        lifetime_ns: 0 for no limit.
    """
    out, head = bytearray(LENGTH.pack(len(rows))), _header(header)
    lifetime = divmod(lifetime_ns, SECOND_NS)
    for row in rows:
        _align(out, 4)
        out += head
        _add_string(out, row.ns)
        _align(out, 4)
        out += IDS.pack(row.id, row.type, row.action)
        _align(out, 8)
        out += BODY.pack(*row.position, 0.0, 0.0, *row.quaternion, *row.scale, *row.color, *lifetime, False)
        _align(out, 4)
        if row.points is None or not len(row.points):
            out += LENGTH.pack(0)
        else:
            out += LENGTH.pack(len(row.points))
            _align(out, 8)
            out += np.asarray(row.points, "<f8").tobytes()
        out += NO_TEXTURE
        _add_string(out, row.text)
        _align(out, 4)
        out += NO_MESH
    return ENCAPSULATION + bytes(out)


def encode_detection_array(
    boxes: np.ndarray,
    labels: Sequence[str],
    scores: Sequence[float] | np.ndarray,
    *,
    header: Any,
    ids: Iterable[int] | None = None,
    covariances: np.ndarray | None = None,
) -> bytes:
    """Return the CDR of the vision_msgs/Detection3DArray of boxes; the arguments are those of
    msg_utils.detections.to_detection_array."""
    head = _header(header)
    numbers = np.asarray(boxes, float).reshape(-1, 7).tolist()
    out = bytearray(head)
    _align(out, 4)
    out += LENGTH.pack(len(numbers))
    spread = np.zeros((len(numbers), 36)) if covariances is None else np.asarray(covariances, "<f8").reshape(-1, 36)
    for i, box, label, score, square in zip(
        range(len(numbers)) if ids is None else ids, numbers, labels, scores, spread, strict=True
    ):
        half = box[6] / 2
        pose = POSE.pack(*box[:3], 0.0, 0.0, math.sin(half), math.cos(half))
        _align(out, 4)
        out += head
        _align(out, 4)
        out += LENGTH.pack(1)
        _add_string(out, label)
        _align(out, 8)
        out += NUMBER.pack(score) + pose + square.tobytes()
        out += pose + SIZE.pack(*box[3:6])
        _add_string(out, str(int(i)))
    return ENCAPSULATION + bytes(out)


def _header(header: Any) -> bytes:
    out = bytearray(STAMP.pack(header.stamp.sec, header.stamp.nanosec))
    _add_string(out, header.frame_id)
    return bytes(out)


def _add_string(out: bytearray, text: str) -> None:
    _align(out, 4)
    data = text.encode()
    out += LENGTH.pack(len(data) + 1) + data + b"\0"


def _align(out: bytearray, size: int) -> None:
    out += bytes(-len(out) % size)
