"""Conversion between labelled boxes and vision_msgs/Detection3DArray."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from msg_utils.markers import MarkedObjects, compute_yaw, make_box_pose
from msg_utils.stamps import to_ns


def to_detection_array(
    boxes: np.ndarray,
    labels: Sequence[str],
    scores: Sequence[float] | np.ndarray,
    *,
    header: Any,
    make: Any,
    ids: Sequence[int] | np.ndarray | None = None,
    covariances: np.ndarray | None = None,
) -> Any:
    """Build a Detection3DArray of boxes (K, 7) [x y z l w h yaw], with one hypothesis each.

    Args:
        ids: K ids, as for markers; default: 0..K-1.
        covariances: (K, 6, 6) of x, y, z and the rotations about them, in metres and radians;
            default: zeros, which mean "unknown", as in sensor_msgs/Imu.
    """
    detections = []
    boxes = np.asarray(boxes, float).reshape(-1, 7)
    ids = range(len(boxes)) if ids is None else ids
    spread = np.zeros((len(boxes), 36)) if covariances is None else covariances.reshape(-1, 36)
    for i, box, label, score, square in zip(ids, boxes, labels, scores, spread, strict=True):
        pose, (length, width, height) = make_box_pose(box, make), map(float, box[3:6])
        hypothesis = make("vision_msgs/msg/ObjectHypothesis", class_id=label, score=float(score))
        detections.append(
            make(
                "vision_msgs/msg/Detection3D",
                header=header,
                id=str(int(i)),
                results=[
                    make(
                        "vision_msgs/msg/ObjectHypothesisWithPose",
                        hypothesis=hypothesis,
                        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=square),
                    )
                ],
                bbox=make(
                    "vision_msgs/msg/BoundingBox3D",
                    center=pose,
                    size=make("geometry_msgs/msg/Vector3", x=length, y=width, z=height),
                ),
            )
        )
    return make("vision_msgs/msg/Detection3DArray", header=header, detections=detections)


def from_detection_array(msg: Any) -> MarkedObjects:
    """Return the objects of a Detection3DArray, each with its most likely class.

    If the ids in the message are not unique numbers, ids are 0..K-1, and the original ids, which
    may be any text, are "id" in extras.
    """
    boxes, labels, scores = [], [], []
    for d in msg.detections:
        p, s = d.bbox.center.position, d.bbox.size
        boxes.append([p.x, p.y, p.z, s.x, s.y, s.z, compute_yaw(d.bbox.center)])
        best = max(d.results, key=lambda r: r.hypothesis.score, default=None)
        labels.append(best.hypothesis.class_id if best else "")
        scores.append(best.hypothesis.score if best else 1.0)
    names = [d.id for d in msg.detections]
    numbered = all(n.isascii() and n.isdigit() and len(n) < 19 for n in names) and len(set(map(int, names))) == len(
        names
    )
    extras = [{"id": n} if n and not numbered else {} for n in names]
    return MarkedObjects(
        np.array(boxes, float).reshape(-1, 7),
        labels,
        np.array(scores, float),
        np.array(names if numbered else range(len(names)), np.int64),
        extras,
        [],
        to_ns(msg.header.stamp),
        msg.header.frame_id,
    )
