"""Matching of detections and labels by centre distance (paper A, Section 3.8)."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

RANGE_NAMES = ("0-15", "15-30", "30-45", "45-60", "60+")
RANGE_LIMITS = np.array([15.0, 30.0, 45.0, 60.0])
MAX_CENTRE_DISTANCE = 1.0  # metres, Section 3.8


def match_centres(
    detections: np.ndarray, labels: np.ndarray, max_distance: float = MAX_CENTRE_DISTANCE
) -> tuple[np.ndarray, np.ndarray]:
    """Match detections (K, >=3) and labels (M, >=3) one to one by their 3D centres.

    The centres of a pair are at most max_distance apart. The number of pairs is maximal; among these
    assignments, the total distance is minimal.

    Returns:
        Indices (P,) of the detections and (P,) of the labels of the pairs.
    """
    distance = np.linalg.norm(detections[:, None, :3].astype(float) - labels[None, :, :3], axis=2)
    return assign_pairs(distance, distance <= max_distance)  # NaN centres match nothing


def assign_pairs(cost: np.ndarray, is_allowed_pair: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Assign rows to columns of a non-negative cost matrix (K, M).

    Only pairs with `is_allowed_pair` (K, M) bool are assigned. The number of pairs is maximal; among these
    assignments, the total cost is minimal. Returns rows (P,) and columns (P,).
    """
    # A forbidden pair costs more than all allowed pairs together.
    forbidden_cost = cost[is_allowed_pair].max(initial=0.0) * cost.size + 1.0
    rows, columns = linear_sum_assignment(np.where(is_allowed_pair, cost, forbidden_cost))
    is_allowed = is_allowed_pair[rows, columns]
    return rows[is_allowed], columns[is_allowed]


def find_range_bins(boxes: np.ndarray) -> np.ndarray:
    """Return the index (K,) into RANGE_NAMES of each box (K, >=2)."""
    return np.searchsorted(RANGE_LIMITS, np.hypot(boxes[:, 0], boxes[:, 1]), side="right")


def count_by_range(
    detections: np.ndarray, labels: np.ndarray, pairs: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Count true positives, false positives and misses of one frame by range.

    True positives and misses are counted at the range of the label, false positives at the range of
    the detection.

    Args:
        detections: (K, 7) detected boxes.
        labels: (M, 7) labelled boxes.
        pairs: Result of match_centres.

    Returns:
        True positives, false positives and misses, (5,) int each by RANGE_NAMES, and the sums (5,)
        of the centre errors, metres.
    """
    i, j = pairs
    label_bins, detection_bins = find_range_bins(labels), find_range_bins(detections)
    bins = len(RANGE_NAMES)
    hits = np.bincount(label_bins[j], minlength=bins)
    misses = np.bincount(label_bins, minlength=bins) - hits
    false_positives = np.bincount(np.delete(detection_bins, i), minlength=bins)
    distances = np.linalg.norm(detections[i, :3].astype(float) - labels[j, :3], axis=1)
    return hits, false_positives, misses, np.bincount(label_bins[j], weights=distances, minlength=bins)


class Score:
    """True positives, false positives, misses and sums of centre errors of one stage, by range."""

    def __init__(self) -> None:
        self.tp, self.fp, self.fn = (np.zeros(len(RANGE_NAMES), int) for _ in range(3))
        self.error = np.zeros(len(RANGE_NAMES))

    def update(self, detections: np.ndarray, labels: np.ndarray) -> None:
        """Add one frame with detected boxes (K, 7) and labelled boxes (M, 7)."""
        counts = count_by_range(detections, labels, match_centres(detections, labels))
        for total, count in zip((self.tp, self.fp, self.fn, self.error), counts):
            total += count

    def make_rows(self) -> dict[str, dict]:
        """Return tp, fp, fn, precision, recall, f1 and centre_error_m for each range and for "all".

        A ratio with denominator 0 is 0. centre_error_m is None without true positives.
        """
        rows = {name: self._make_row(i) for i, name in enumerate(RANGE_NAMES)}
        return {**rows, "all": self._make_row(slice(None))}

    def _make_row(self, index) -> dict:
        tp, fp, fn = (int(np.sum(a[index])) for a in (self.tp, self.fp, self.fn))
        return dict(
            tp=tp,
            fp=fp,
            fn=fn,
            precision=tp / (tp + fp) if tp + fp else 0.0,
            recall=tp / (tp + fn) if tp + fn else 0.0,
            f1=2 * tp / (2 * tp + fp + fn) if tp + fp + fn else 0.0,
            centre_error_m=float(np.sum(self.error[index])) / tp if tp else None,
        )
