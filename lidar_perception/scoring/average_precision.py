"""Average precision at 11 and at 40 recall points, sampled as in KITTI's benchmark.

It is the mean over recall points of the highest precision at that recall or above. The points are
0, 0.1 .. 1 (Everingham et al., IJCV 2010) or 1/40, 2/40 .. 1 (Simonelli et al., ICCV 2019).

KITTI's own program samples 41 points from the scores of the true positives, each score at most
once. With fewer objects than points some points remain empty: if all n objects are detected, the
result is (n - 1) / 40 instead of 1. For fewer than 41 objects, the points are therefore sampled
from the complete curve here, according to the definition above. For 41 or more objects the result
is the same as from KITTI's program.
"""

from __future__ import annotations

import numpy as np

STEPS = 40  # number of recall steps from 0 to 1
MIN_OBJECTS = STEPS + 1  # minimum number of objects to fill all recall points


def choose_thresholds(scores: np.ndarray, objects: int) -> np.ndarray:
    """Choose the score thresholds (T,), in descending order, at which precision is sampled.

    These are the scores whose recall is nearest to 0, 1/40, .. 1, or all scores for fewer than
    MIN_OBJECTS objects.

    Args:
        scores: (N,) scores of the true positives.
        objects: Number of labelled objects, at least N.
    """
    sorted_scores = np.sort(scores)[::-1]
    if objects < MIN_OBJECTS or len(sorted_scores) == 0:
        return sorted_scores
    indices, target_recall = [], 0.0
    for i in range(len(sorted_scores)):
        recall, next_recall = (i + 1) / objects, (i + 2) / objects
        if i + 1 == len(sorted_scores) or next_recall - target_recall >= target_recall - recall:
            indices.append(i)
            target_recall += 1 / STEPS
    return sorted_scores[indices[:MIN_OBJECTS]]


def sample_curve(values: np.ndarray, objects: int) -> np.ndarray:
    """Return the highest value (41,) at or above each recall 0, 1/40, .. 1. It is 0 at recalls that are not reached.

    Args:
        values: (T,) value at each threshold of choose_thresholds.
        objects: Number of labelled objects.
    """
    best_values = np.maximum.accumulate(values[::-1])[::-1]
    curve = np.zeros(MIN_OBJECTS)
    if objects >= MIN_OBJECTS:
        curve[: len(best_values)] = best_values
        return curve
    # Index of the first true positive that reaches each recall.
    threshold_indices = np.maximum((np.arange(MIN_OBJECTS) * objects + STEPS - 1) // STEPS - 1, 0)
    is_reached = threshold_indices < len(best_values)
    curve[is_reached] = best_values[threshold_indices[is_reached]]
    return curve


def average_curve(curve: np.ndarray) -> tuple[float, float]:
    """Return the averages of a curve (41,) over 11 and over 40 recall points, in percent."""
    return 100 * float(curve[::4].mean()), 100 * float(curve[1:].mean())
