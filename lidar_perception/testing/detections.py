"""Comparison of detections with expected objects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from lidar_perception.geometry import iou_3d
from lidar_perception.scoring.centres.matching import MAX_CENTRE_DISTANCE, assign_pairs
from lidar_perception.types import CLASSES, InputError
from msg_utils.detections import from_detection_array
from msg_utils.markers import from_marker_array

__tracebackhide__ = True  # makes pytest show the line in the test

MAX_LISTED = 20  # maximum number of missing objects, and of extra objects, in an error message


class Objects(NamedTuple):
    """K detected or expected objects.

    Attributes:
        boxes: (K, 7) float64 [x y z l w h yaw]; if only the centre is given, the other values are
            NaN.
        labels: K class names.
        scores: (K,) float64, 1 for objects without a score.
    """

    boxes: np.ndarray
    labels: list[str]
    scores: np.ndarray


def to_objects(source: Any) -> Objects:
    """Convert detections or labels to Objects.

    Args:
        source: A MarkerArray or Detection3DArray (rclpy or rosbags), Detections, GroundTruth, or
            pairs (class name, box), where a box is [x y z l w h yaw] or only [x y z].

    Raises:
        InputError: The type is not supported.
    """
    if hasattr(source, "markers"):
        source = from_marker_array(source)
    elif hasattr(source, "detections"):
        source = from_detection_array(source)
    if hasattr(source, "class_ids"):
        labels = [CLASSES[i] for i in source.class_ids]
    elif hasattr(source, "labels"):
        labels = list(source.labels)
    else:
        return _from_pairs(source)
    boxes = np.asarray(source.boxes, np.float64).reshape(-1, 7)
    return Objects(boxes, labels, np.asarray(getattr(source, "scores", np.ones(len(boxes))), float))


def _from_pairs(pairs: Any) -> Objects:
    try:
        labels = [str(label) for label, _ in pairs]
        boxes = np.full((len(labels), 7), np.nan)
        for row, (_, box) in zip(boxes, pairs):
            if len(box) not in (3, 7):
                raise ValueError
            row[: len(box)] = box
    except (TypeError, ValueError):
        raise InputError(
            f"{type(pairs).__name__} is not a MarkerArray, Detection3DArray, "
            "Detections, GroundTruth or list of (class name, [x y z l w h yaw] or "
            "[x y z])"
        ) from None
    return Objects(boxes, labels, np.ones(len(boxes)))


def assert_detections(
    detections: Any,
    expected: Any,
    *,
    max_distance: float = MAX_CENTRE_DISTANCE,
    min_iou: float | None = None,
    same_class: bool = True,
    max_missing: int = 0,
    max_extra: int | None = 0,
) -> list[tuple[int, int]]:
    """Assert that detections match the expected objects.

    Detections and objects are matched one to one, such that the number of pairs is as large as
    possible, and then their total distance as small as possible.

    Args:
        detections, expected: Objects of any type that to_objects() accepts.
        max_distance: Maximum distance between the centres of a pair, metres.
        min_iou: Minimum 3D IoU of a pair; if given, it replaces max_distance.
        same_class: True if the classes of a pair must be equal.
        max_missing: Maximum number of expected objects without a detection.
        max_extra: Maximum number of detections without an object, None for any number.

    Returns:
        (index into detections, index into expected) of each pair.

    Raises:
        AssertionError: Too many objects are missing or extra; the message lists them.
    """
    detected_objects, expected_objects = to_objects(detections), to_objects(expected)
    if min_iou is not None and not np.isfinite(expected_objects.boxes).all():
        raise InputError("min_iou needs complete boxes; some expected objects have only a centre")
    distance = np.linalg.norm(detected_objects.boxes[:, None, :3] - expected_objects.boxes[None, :, :3], axis=2)
    if min_iou is None:
        cost, can_match = distance, distance <= max_distance
    else:
        overlap = iou_3d(detected_objects.boxes, expected_objects.boxes)
        cost, can_match = 1 - overlap, (overlap >= min_iou) & (overlap > 0)
    if same_class:
        can_match &= np.array(
            [
                [detected_label == expected_label for expected_label in expected_objects.labels]
                for detected_label in detected_objects.labels
            ],
            bool,
        ).reshape(can_match.shape)
    rows, columns = assign_pairs(cost, can_match)
    missing_rows = sorted(set(range(len(expected_objects.boxes))) - set(columns.tolist()))
    extra_rows = sorted(set(range(len(detected_objects.boxes))) - set(rows.tolist()))
    if len(missing_rows) > max_missing or (max_extra is not None and len(extra_rows) > max_extra):
        rule = f"centres at most {max_distance:g} m apart" if min_iou is None else f"3D IoU at least {min_iou:g}"
        raise AssertionError(
            "\n".join(
                [
                    f"{len(rows)} of {len(expected_objects.boxes)} expected objects were detected, "
                    f"and {len(extra_rows)} extra objects ({rule}{', of the same class' if same_class else ''})",
                    *_list_objects("missing", expected_objects, missing_rows, detected_objects, distance.T),
                    *_list_objects("extra", detected_objects, extra_rows, expected_objects, distance),
                ]
            )
        )
    return list(zip(rows.tolist(), columns.tolist()))


def _list_objects(word: str, objects: Objects, rows: Sequence[int], others: Objects, distance: np.ndarray) -> list[str]:
    """Describe the objects in the given rows, one per line, each with the nearest of the others."""
    lines = []
    for i in rows[:MAX_LISTED]:
        box = objects.boxes[i]
        size = "" if np.isnan(box[3]) else " size {:.2f} {:.2f} {:.2f}, yaw {:.2f}".format(*box[3:])
        nearest_text = ""
        if len(others.boxes):
            j = int(np.argmin(np.nan_to_num(distance[i], nan=np.inf)))
            nearest_text = f"; nearest: {others.labels[j]}, {distance[i, j]:.2f} m away"
        score = f", score {objects.scores[i]:.2f}" if word == "extra" else ""
        lines.append(
            f"  {word}: {objects.labels[i]} at ({box[0]:.2f}, {box[1]:.2f}, {box[2]:.2f}){size}{score}{nearest_text}"
        )
    if len(rows) > MAX_LISTED:
        lines.append(f"  ... and {len(rows) - MAX_LISTED} more {word}")
    return lines
