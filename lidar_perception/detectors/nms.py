"""Exact non-maximum suppression (NMS) of rotated boxes.

It runs on the CPU, which is faster than a GPU for the few hundred boxes above the threshold.
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
    """Apply NMS and return the remaining boxes as detections, highest score first.

    Args:
        boxes: (N, 7).
        scores: (N,).
        labels: (N,) int, indices into `classes`.
    """
    indices = rotated_nms(boxes, scores, labels, params.iou, params.across_classes)[: params.max_boxes]
    ids = np.array([CLASSES.index(name) for name in classes])
    return Detections.of(boxes[indices], ids[labels[indices]], scores[indices])


def rotated_nms(
    boxes: np.ndarray, scores: np.ndarray, labels: np.ndarray, iou: float, across_classes: bool = False
) -> np.ndarray:
    """Return the indices (M,) int64 of the boxes that remain after NMS, highest score first.

    A box is dropped if its bird's-eye-view IoU with a remaining box of the same label and a higher
    score is above `iou`. Boxes with equal scores keep their order.

    Args:
        boxes: (N, 7).
        scores: (N,).
        labels: (N,) int.
        across_classes: boxes with different labels suppress each other too.
    """
    order = np.argsort(-scores, kind="stable")
    group = np.zeros(len(order), np.int64) if across_classes else np.asarray(labels, np.int64)[order]
    sorted_boxes = np.asarray(boxes, np.float64).reshape(-1, 7)[order]
    return order[_select_best(sorted_boxes, group, iou, np.argsort(sorted_boxes[:, 0]))]


@njit(cache=True, nogil=True)
def _select_best(boxes, group, iou, x_order):
    """Return a mask (N,) bool of the boxes that remain; boxes are sorted by score."""
    is_kept = np.ones(len(boxes), np.bool_)
    radii, corner_buffer = footprint_radii(boxes), np.empty((4, MAX_CORNERS))
    area = boxes[:, 3] * boxes[:, 4]
    x, max_radius = boxes[x_order, 0], 0.0
    for r in radii:
        if r > max_radius:  # False for NaN, the radius of boxes that overlap nothing
            max_radius = r
    for i in range(len(boxes)):
        if not is_kept[i] or not radii[i] > 0:
            continue
        max_distance = radii[i] + max_radius
        for position in range(lower_bound(x, boxes[i, 0] - max_distance), len(x)):
            if x[position] > boxes[i, 0] + max_distance:
                break
            j = x_order[position]
            if j > i and is_kept[j] and group[i] == group[j]:
                overlap = overlap_area(boxes[i], boxes[j], radii[i] + radii[j], corner_buffer)
                is_kept[j] = overlap <= 0 or overlap / (area[i] + area[j] - overlap) <= iou
    return is_kept


@njit(cache=True, nogil=True)
def keep_first(is_duplicate):
    """Return a mask (N,) bool that keeps the first of each set of duplicates.

    Args:
        is_duplicate: (N, N) bool; item j is dropped if is_duplicate[i, j] for a kept i < j.
    """
    is_kept = np.ones(len(is_duplicate), np.bool_)
    for i in range(len(is_duplicate)):
        if is_kept[i]:
            for j in range(i + 1, len(is_duplicate)):
                if is_duplicate[i, j]:
                    is_kept[j] = False
    return is_kept
