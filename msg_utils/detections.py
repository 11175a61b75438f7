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
        boxes: (K, 7) boxes.
        labels: K class names.
        scores: K scores.
        header: Header of the array and of each detection.
        make: Function that creates messages, see msg_utils.
        ids: K ids as for markers, by default 0..K-1.
        covariances: (K, 6, 6) pose covariances of x, y, z, roll, pitch, yaw in metres and radians.
            By default zeros, which mean "unknown", as in sensor_msgs/Imu.
    """
    detections = []
    boxes = np.asarray(boxes, float).reshape(-1, 7)
    ids = range(len(boxes)) if ids is None else ids
    covariance_rows = np.zeros((len(boxes), 36)) if covariances is None else covariances.reshape(-1, 36)
    for i, box, label, score, covariance in zip(ids, boxes, labels, scores, covariance_rows, strict=True):
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
                        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance),
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
    """Convert a Detection3DArray to objects, each with its most likely class.

    If the ids in the message are not unique numbers, the objects get the ids 0..K-1, and extras
    contain the original ids (any text) as "id".
    """
    boxes, labels, scores = [], [], []
    for detection in msg.detections:
        position, size = detection.bbox.center.position, detection.bbox.size
        boxes.append([position.x, position.y, position.z, size.x, size.y, size.z, compute_yaw(detection.bbox.center)])
        best_result = max(detection.results, key=lambda r: r.hypothesis.score, default=None)
        labels.append(best_result.hypothesis.class_id if best_result else "")
        scores.append(best_result.hypothesis.score if best_result else 1.0)
    names = [detection.id for detection in msg.detections]
    has_numeric_ids = all(name.isascii() and name.isdigit() and len(name) < 19 for name in names) and len(
        set(map(int, names))
    ) == len(names)
    extras = [{"id": name} if name and not has_numeric_ids else {} for name in names]
    return MarkedObjects(
        np.array(boxes, float).reshape(-1, 7),
        labels,
        np.array(scores, float),
        np.array(names if has_numeric_ids else range(len(names)), np.int64),
        extras,
        [],
        to_ns(msg.header.stamp),
        msg.header.frame_id,
    )
