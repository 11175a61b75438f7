"""Exact non-maximum suppression of rotated boxes.

It runs on the CPU. For the few hundred boxes above the score threshold, a GPU would be slower.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.detectors.params import NmsParams
from lidar_perception.geometry import MAX_CORNERS, footprint_radii, lower_bound, overlap_area
from lidar_perception.types import CLASSES, Detections


def apply_nms(
    boxes: np.ndarray, scores: np.ndarray, labels: np.ndarray, classes: tuple[str, ...], params: NmsParams
) -> Detections:
    """Return the boxes that survive NMS as detections, best score first.

    Args:
        boxes: (N, 7), with scores (N,).
        labels: (N,) int, indices into `classes`.
    """
    kept = rotated_nms(boxes, scores, labels, params.iou, params.across_classes)[: params.max_boxes]
    ids = np.array([CLASSES.index(name) for name in classes])
    return Detections.of(boxes[kept], ids[labels[kept]], scores[kept])


def rotated_nms(
    boxes: np.ndarray, scores: np.ndarray, labels: np.ndarray, iou: float, across_classes: bool = False
) -> np.ndarray:
    """Return the indices (M,) int64 of the boxes (N, 7) that survive, best score first; equal
    scores keep their order.

    A box is dropped if a surviving box has a higher score, the same label (N,) int (any label with
    across_classes), and a bird's-eye-view IoU with it above `iou`.
    """
    order = np.argsort(-scores, kind="stable")
    group = np.zeros(len(order), np.int64) if across_classes else np.asarray(labels)[order]
    ordered = np.asarray(boxes, np.float64).reshape(-1, 7)[order]
    return order[_is_kept(ordered, group, iou, np.argsort(ordered[:, 0]))]


@njit(cache=True, nogil=True)
def _is_kept(boxes, group, iou, by_x):
    kept = np.ones(len(boxes), np.bool_)
    reach, work = footprint_radii(boxes), np.empty((4, MAX_CORNERS))
    area = boxes[:, 3] * boxes[:, 4]
    x, max_reach = boxes[by_x, 0], 0.0
    for r in reach:
        if r > max_reach:  # False for NaN, the radius of boxes that overlap nothing
            max_reach = r
    for i in range(len(boxes)):
        if not kept[i] or not reach[i] > 0:
            continue
        far = reach[i] + max_reach
        for place in range(lower_bound(x, boxes[i, 0] - far), len(x)):
            if x[place] > boxes[i, 0] + far:
                break
            j = by_x[place]
            if j > i and kept[j] and group[i] == group[j]:
                shared = overlap_area(boxes[i], boxes[j], reach[i] + reach[j], work)
                kept[j] = shared <= 0 or shared / (area[i] + area[j] - shared) <= iou
    return kept


@njit(cache=True, nogil=True)
def keep_first(is_duplicate):
    """Return which of N items to keep, (N,) bool.

    Args:
        is_duplicate: (N, N) bool; item j is dropped if is_duplicate[i, j] for an earlier kept i.
    """
    kept = np.ones(len(is_duplicate), np.bool_)
    for i in range(len(is_duplicate)):
        if kept[i]:
            for j in range(i + 1, len(is_duplicate)):
                if is_duplicate[i, j]:
                    kept[j] = False
    return kept
