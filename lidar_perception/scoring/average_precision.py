"""Average precision at 11 and at 40 recall points, sampled as in KITTI's benchmark.

The mean over recall points of the highest precision at that recall or above: 11 points 0, 0.1 .. 1
(Everingham et al., IJCV 2010), or 40 points 1/40 .. 1 (Simonelli et al., ICCV 2019).

KITTI's program samples 41 points from the scores of the true positives, each at most once. With
fewer objects than points it leaves points empty: n objects that are all detected score (n - 1) / 40
instead of 1. For fewer than 41 objects the points are therefore sampled from the whole curve here,
by the definition above; for 41 or more the result equals that of KITTI's program. Its result is
also available (official=True).
"""

from __future__ import annotations

import numpy as np

STEPS = 40  # number of recall steps from 0 to 1
MIN_OBJECTS = STEPS + 1  # objects needed to fill all points


def choose_thresholds(scores: np.ndarray, objects: int) -> np.ndarray:
    """Choose the descending score thresholds (T,) at which precision is sampled.

    They are the scores of true positives (N,) with the recall nearest to 0, 1/40, .. 1, or all
    scores for fewer than MIN_OBJECTS objects. objects is the number of labelled objects, at least
    N.
    """
    ordered = np.sort(scores)[::-1]
    if objects < MIN_OBJECTS or len(ordered) == 0:
        return ordered
    chosen, wanted = [], 0.0
    for i in range(len(ordered)):
        recall, following = (i + 1) / objects, (i + 2) / objects
        if i + 1 == len(ordered) or following - wanted >= wanted - recall:
            chosen.append(i)
            wanted += 1 / STEPS
    return ordered[chosen[:MIN_OBJECTS]]


def sample_curve(values: np.ndarray, objects: int, official: bool = False) -> np.ndarray:
    """Sample the highest of values (T,) at recall 0, 1/40, .. 1 or above, as (41,).

    values belong to the thresholds of choose_thresholds. Recall that is not reached gives 0.
    """
    best = np.maximum.accumulate(values[::-1])[::-1]
    curve = np.zeros(MIN_OBJECTS)
    if objects >= MIN_OBJECTS or official:
        curve[: len(best)] = best
        return curve
    # the first true positive that reaches the recall
    index = np.maximum((np.arange(MIN_OBJECTS) * objects + STEPS - 1) // STEPS - 1, 0)
    reached = index < len(best)
    curve[reached] = best[index[reached]]
    return curve


def average_curve(curve: np.ndarray) -> tuple[float, float]:
    """Return the average in percent at 11 and at 40 recall points of a curve (41,)."""
    return 100 * float(curve[::4].mean()), 100 * float(curve[1:].mean())
