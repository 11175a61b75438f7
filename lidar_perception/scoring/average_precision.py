"""Average precision at 11 and at 40 recall points, as KITTI's benchmark samples it.

Everingham et al., IJCV 2010: the mean, over recall points, of the best precision at that recall or
beyond (11 points: 0, 0.1 .. 1). Simonelli et al., ICCV 2019: 40 points, 1/40 .. 1, without 0.

KITTI's program samples 41 points, from the scores of the true positives, each of them at most
once. With fewer objects than points it leaves points empty: n objects found without an error then
score (n - 1) / 40, and not 1. So where there are fewer than 41 objects the points are read off the
whole curve here, by the definition above; from 41 objects on they are those of KITTI's program.
What that program would give is there as well (official=True).
"""

from __future__ import annotations

import numpy as np

STEPS = 40            # between recall 0 and 1
MIN_OBJECTS = STEPS + 1       # objects needed to fill all points


def choose_thresholds(scores: np.ndarray, objects: int) -> np.ndarray:
    """(T,) descending scores to take precision at: of the scores (N,) of true positives those
    whose recall is nearest to 0, 1/40, .. 1; all of them where objects < FEW.

    objects is how many there are to find, at least N.
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
    """(41,) the best of values (T,), taken at recall_thresholds, at recall 0, 1/40, .. 1 or beyond;
    0 where it is not reached."""
    best = np.maximum.accumulate(values[::-1])[::-1]
    curve = np.zeros(MIN_OBJECTS)
    if objects >= MIN_OBJECTS or official:
        curve[:len(best)] = best
        return curve
    # The first true positive with which that recall is reached.
    index = np.maximum((np.arange(MIN_OBJECTS) * objects + STEPS - 1) // STEPS - 1, 0)
    reached = index < len(best)
    curve[reached] = best[index[reached]]
    return curve


def average_curve(curve: np.ndarray) -> tuple[float, float]:
    """Percent at 11 and at 40 recall points of a curve (41,)."""
    return 100 * float(curve[::4].mean()), 100 * float(curve[1:].mean())
