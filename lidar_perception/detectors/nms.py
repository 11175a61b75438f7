"""Non-maximum suppression of turned boxes, exact, on the CPU.

The few hundred boxes that are left after the score threshold are compared faster there than a GPU
can be asked.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.detectors.params import NmsParams
from lidar_perception.geometry import MAX_CORNERS, footprint_radii, overlap_area
from lidar_perception.types import CLASSES, Detections


def best_of_each(boxes: np.ndarray, scores: np.ndarray, labels: np.ndarray,
                 classes: tuple[str, ...], params: NmsParams) -> Detections:
    """Detections, best first, of the boxes (N, 7) with scores (N,) that stay; labels (N,) int are
    indices in classes."""
    kept = suppressed(boxes, scores, labels, params.iou, params.across_classes)[:params.max_boxes]
    ids = np.array([CLASSES.index(name) for name in classes])
    return Detections.of(boxes[kept], ids[labels[kept]], scores[kept])


def suppressed(boxes: np.ndarray, scores: np.ndarray, labels: np.ndarray, iou: float,
               across_classes: bool = False) -> np.ndarray:
    """(M,) int64 indices of the boxes (N, 7) that stay, best score first, then the first.

    A box goes if one that stays has a higher score, the same label (N,) int (any, with
    across_classes) and an IoU above iou, seen from above.
    """
    order = np.argsort(-scores, kind="stable")
    group = np.zeros(len(order), np.int64) if across_classes else np.asarray(labels)[order]
    ordered = np.asarray(boxes, np.float64).reshape(-1, 7)[order]
    return order[_stay(ordered, group, iou)]


@njit(cache=True, nogil=True)
def _stay(boxes, group, iou):
    stays = np.ones(len(boxes), np.bool_)
    reach, work = footprint_radii(boxes), np.empty((4, MAX_CORNERS))
    area = boxes[:, 3] * boxes[:, 4]
    for i in range(len(boxes)):
        if not stays[i]:
            continue
        for j in range(i + 1, len(boxes)):
            if stays[j] and group[i] == group[j]:
                shared = overlap_area(boxes[i], boxes[j], reach[i] + reach[j], work)
                stays[j] = shared <= 0 or shared / (area[i] + area[j] - shared) <= iou
    return stays


@njit(cache=True, nogil=True)
def first_of_each(again):
    """(N,) bool: which stay of N things, again (N, N) bool: one goes that is one which stays, and
    stands before it, again."""
    stays = np.ones(len(again), np.bool_)
    for i in range(len(again)):
        if stays[i]:
            for j in range(i + 1, len(again)):
                if again[i, j]:
                    stays[j] = False
    return stays
