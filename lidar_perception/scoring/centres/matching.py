"""Matching of detections and labels by centre distance (paper A, Section 3.8)."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

RANGE_NAMES = ("0-15", "15-30", "30-45", "45-60", "60+")
RANGE_LIMITS = np.array([15.0, 30.0, 45.0, 60.0])
MAX_CENTRE_DISTANCE = 1.0  # metres, Section 3.8


def match_centres(
    found: np.ndarray, truth: np.ndarray, max_distance: float = MAX_CENTRE_DISTANCE
) -> tuple[np.ndarray, np.ndarray]:
    """Match boxes one to one whose 3D centres are at most max_distance apart.

    As many pairs as possible, then the least total distance. Returns the rows (P,) of found (K,
    >=3) and of truth (M, >=3).
    """
    distance = np.linalg.norm(found[:, None, :3].astype(float) - truth[None, :, :3], axis=2)
    return assign_pairs(distance, distance <= max_distance)  # NaN centres match nothing


def assign_pairs(cost: np.ndarray, allowed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Assign rows to columns of a non-negative cost (K, M) where allowed (K, M) bool.

    As many pairs as possible, then the least total cost. Returns rows (P,) and columns (P,).
    """
    # so that a forbidden pair costs more than all allowed pairs together
    forbidden = cost[allowed].max(initial=0.0) * cost.size + 1.0
    rows, columns = linear_sum_assignment(np.where(allowed, cost, forbidden))
    keep = allowed[rows, columns]
    return rows[keep], columns[keep]


def find_range_bins(boxes: np.ndarray) -> np.ndarray:
    """Return the index (K,) into RANGE_NAMES of the horizontal range of boxes (K, >=2)."""
    return np.searchsorted(RANGE_LIMITS, np.hypot(boxes[:, 0], boxes[:, 1]), side="right")


def count_by_range(
    found: np.ndarray, truth: np.ndarray, pairs: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Count the detections of one frame by RANGE_NAMES.

    A true positive and a miss belong to the range of the label, a false positive to its own.

    Args:
        found: (K, 7) detected boxes.
        truth: (M, 7) labelled boxes.
        pairs: result of match_centres.

    Returns:
        True positives, false positives, misses, each (5,) int, and summed centre errors (5,),
        metres.
    """
    i, j = pairs
    true_bin, found_bin = find_range_bins(truth), find_range_bins(found)
    bins = len(RANGE_NAMES)
    hits = np.bincount(true_bin[j], minlength=bins)
    misses = np.bincount(true_bin, minlength=bins) - hits
    false = np.bincount(np.delete(found_bin, i), minlength=bins)
    error = np.linalg.norm(found[i, :3].astype(float) - truth[j, :3], axis=1)
    return hits, false, misses, np.bincount(true_bin[j], weights=error, minlength=bins)


class Score:
    """Counts of one stage by range: true and false positives, misses, centre errors."""

    def __init__(self) -> None:
        self.tp, self.fp, self.fn = (np.zeros(len(RANGE_NAMES), int) for _ in range(3))
        self.error = np.zeros(len(RANGE_NAMES))

    def update(self, found: np.ndarray, truth: np.ndarray) -> None:
        """Add one frame with detected boxes (K, 7) and labelled boxes (M, 7)."""
        counts = count_by_range(found, truth, match_centres(found, truth))
        for total, count in zip((self.tp, self.fp, self.fn, self.error), counts):
            total += count

    def make_rows(self) -> dict[str, dict]:
        """Return tp, fp, fn, precision, recall, f1 and centre_error_m by range name and for "all".

        A ratio without cases is 0; centre_error_m is None without hits.
        """
        rows = {name: self._row(i) for i, name in enumerate(RANGE_NAMES)}
        return {**rows, "all": self._row(slice(None))}

    def _row(self, index) -> dict:
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
