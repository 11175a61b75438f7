"""Ground that climbs away from a cloth (after Zhang et al., Remote Sensing 2016, Section 2.5)."""

from __future__ import annotations

import numpy as np
from numba import njit

UNOBSERVED = np.float32(np.inf)
REACH, STEP = 6, 0.05  # cells, and m, over which the ground goes on
# Squared distance, rows and columns of the cells around one, the nearest first.
AROUND = np.array(sorted((i * i + j * j, i, j) for i in range(-REACH, REACH + 1)
                         for j in range(-REACH, REACH + 1) if 0 < i * i + j * j <= REACH * REACH))


@njit(cache=True, nogil=True)
def climbed_cells(lowest, height, threshold, slope):
    """(R, C) bool: cells over a cloth of height (R, C) that go on from one that it touches (lowest
    point (R, C) within threshold, metres; UNOBSERVED where there is none), or from another such
    cell: their lowest point is at most STEP and `slope` a cell above that of the nearest one, at
    most REACH cells away; of several as near, the lowest. All cells of a round look at the round
    before, so no order matters.

    A cloth bends less than some roads and loses them where they begin to climb, between the rings
    of points of which it hangs free. What stands on the road begins higher than the road goes on.
    """
    rows, columns = lowest.shape
    touched, climbed = np.zeros(lowest.shape, np.bool_), np.zeros(lowest.shape, np.bool_)
    asked = np.zeros(lowest.shape, np.int32)  # the round in which a cell was asked last
    waiting = []
    for r in range(rows):
        for c in range(columns):
            if lowest[r, c] != UNOBSERVED:
                touched[r, c] = lowest[r, c] - height[r, c] <= threshold
                if not touched[r, c]:
                    waiting.append((r, c))
    turn = 0
    while len(waiting):
        turn += 1
        new = []
        for r, c in waiting:
            nearest, base = REACH * REACH + 1, 0.0
            for away, down, right in AROUND:
                if away > nearest:
                    break
                i, j = r + down, c + right
                if 0 <= i < rows and 0 <= j < columns and touched[i, j]:
                    if away < nearest or lowest[i, j] < base:
                        base = lowest[i, j]
                    nearest = away
            if nearest <= REACH * REACH and (
                    lowest[r, c] - base <= STEP + slope * np.sqrt(nearest)):
                new.append((r, c))
        waiting.clear()
        for r, c in new:
            touched[r, c] = climbed[r, c] = True
        for r, c in new:
            for i in range(max(r - REACH, 0), min(r + REACH + 1, rows)):
                for j in range(max(c - REACH, 0), min(c + REACH + 1, columns)):
                    if lowest[i, j] != UNOBSERVED and not touched[i, j] and asked[i, j] < turn:
                        asked[i, j] = turn
                        waiting.append((i, j))
    return climbed
