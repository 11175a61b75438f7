"""Comparison of detections of any type with expected objects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from lidar_perception.geometry import iou_3d
from lidar_perception.scoring.centres.matching import MAX_CENTRE_DISTANCE, assign_pairs
from lidar_perception.types import CLASSES, InputError
from msg_utils.detections import from_detection_array
from msg_utils.markers import from_marker_array

__tracebackhide__ = True  # so that pytest shows the line in the test

MAX_LISTED = 20  # maximum number of missing and of extra objects to list


class Objects(NamedTuple):
    """Objects of any source.

    boxes (K, 7) float64 [x y z l w h yaw], with NaN where only a centre is given; labels are K
    class names; scores (K,) float64 are 1 where there are none.
    """

    boxes: np.ndarray
    labels: list[str]
    scores: np.ndarray


def to_objects(given: Any) -> Objects:
    """Convert detections or labels to Objects.

    Args:
        given: a MarkerArray or Detection3DArray of rclpy or rosbags, Detections, GroundTruth, or
            pairs (class name, box), where a box is [x y z l w h yaw] or only [x y z].

    Raises:
        InputError: for other types.
    """
    if hasattr(given, "markers"):
        given = from_marker_array(given)
    elif hasattr(given, "detections"):
        given = from_detection_array(given)
    if hasattr(given, "class_ids"):
        labels = [CLASSES[i] for i in given.class_ids]
    elif hasattr(given, "labels"):
        labels = list(given.labels)
    else:
        return _from_pairs(given)
    boxes = np.asarray(given.boxes, np.float64).reshape(-1, 7)
    return Objects(boxes, labels, np.asarray(getattr(given, "scores", np.ones(len(boxes))), float))


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
    found: Any,
    expected: Any,
    *,
    max_distance: float = MAX_CENTRE_DISTANCE,
    min_iou: float | None = None,
    same_class: bool = True,
    max_missing: int = 0,
    max_extra: int | None = 0,
) -> list[tuple[int, int]]:
    """Assert that the detections match the expected objects, both as to_objects() takes them.

    Detections and objects are paired one to one: as many pairs as possible, then the closest.

    Args:
        max_distance: largest distance of the centres of a pair in metres.
        min_iou: smallest 3D IoU of a pair, in place of max_distance.
        same_class: pairs must have the same class.
        max_missing, max_extra: how many objects may be missed, and how many detections may have no
            object; None for any number.

    Returns:
        (row of found, row of expected) of each pair.

    Raises:
        AssertionError: listing the missing and the extra objects.
    """
    a, b = to_objects(found), to_objects(expected)
    if min_iou is not None and not np.isfinite(b.boxes).all():
        raise InputError("min_iou needs complete boxes; some expected objects have only a centre")
    distance = np.linalg.norm(a.boxes[:, None, :3] - b.boxes[None, :, :3], axis=2)
    if min_iou is None:
        cost, close = distance, distance <= max_distance
    else:
        overlap = iou_3d(a.boxes, b.boxes)
        cost, close = 1 - overlap, (overlap >= min_iou) & (overlap > 0)
    if same_class:
        close &= np.array([[x == y for y in b.labels] for x in a.labels], bool).reshape(close.shape)
    rows, columns = assign_pairs(cost, close)
    missing = sorted(set(range(len(b.boxes))) - set(columns.tolist()))
    extra = sorted(set(range(len(a.boxes))) - set(rows.tolist()))
    if len(missing) > max_missing or (max_extra is not None and len(extra) > max_extra):
        rule = f"centres at most {max_distance:g} m apart" if min_iou is None else f"3D IoU at least {min_iou:g}"
        raise AssertionError(
            "\n".join(
                [
                    f"{len(rows)} of {len(b.boxes)} expected objects were found, {len(extra)} more were "
                    f"found ({rule}{', of the same class' if same_class else ''})",
                    *_list_objects("missing", b, missing, a, distance.T),
                    *_list_objects("extra", a, extra, b, distance),
                ]
            )
        )
    return list(zip(rows.tolist(), columns.tolist()))


def _list_objects(word: str, objects: Objects, rows: Sequence[int], others: Objects, distance: np.ndarray) -> list[str]:
    """Return a line for each of the rows, with the nearest of the others."""
    lines = []
    for i in rows[:MAX_LISTED]:
        box = objects.boxes[i]
        size = "" if np.isnan(box[3]) else " size {:.2f} {:.2f} {:.2f}, yaw {:.2f}".format(*box[3:])
        nearest = ""
        if len(others.boxes):
            j = int(np.argmin(np.nan_to_num(distance[i], nan=np.inf)))
            nearest = f"; nearest: {others.labels[j]}, {distance[i, j]:.2f} m away"
        score = f", score {objects.scores[i]:.2f}" if word == "extra" else ""
        lines.append(
            f"  {word}: {objects.labels[i]} at ({box[0]:.2f}, {box[1]:.2f}, {box[2]:.2f}){size}{score}{nearest}"
        )
    if len(rows) > MAX_LISTED:
        lines.append(f"  ... and {len(rows) - MAX_LISTED} more {word}")
    return lines
