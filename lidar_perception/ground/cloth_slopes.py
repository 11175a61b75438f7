"""Ground that climbs faster than a cloth bends (after Zhang et al., Remote Sensing 2016, 2.5)."""

from __future__ import annotations

import numpy as np
from numba import njit

UNOBSERVED = np.float32(np.inf)
REACH_CELLS, STEP_M = 6, 0.05  # maximum gap and step over which the ground continues
# Squared distance, row offset and column offset of the cells around a cell, nearest first.
NEIGHBOURS = np.array(
    sorted(
        (i * i + j * j, i, j)
        for i in range(-REACH_CELLS, REACH_CELLS + 1)
        for j in range(-REACH_CELLS, REACH_CELLS + 1)
        if 0 < i * i + j * j <= REACH_CELLS**2
    )
)


@njit(cache=True, nogil=True)
def find_climbing_cells(lowest, height, threshold, slope):
    """Find the cells that continue the ground uphill from the cells that the cloth touches.

    A cloth bends less than some roads and leaves them where they begin to climb, because it hangs
    free between the rings of points. Objects on the road begin higher than the road's slope.

    A cell continues the ground if its lowest point is at most STEP_M plus `slope` per cell above
    the lowest point of the nearest ground cell, at most REACH_CELLS away (of equally near cells,
    the lowest counts). All cells of a round use the result of the previous round, so the order of
    the cells does not matter.

    Args:
        lowest: (R, C) lowest point of each cell in metres, UNOBSERVED for cells without points.
        height: (R, C) height of the cloth, which touches a cell whose lowest point is within
            `threshold`.
        slope: rise per cell in metres.

    Returns:
        (R, C) bool, without the cells that the cloth touches.
    """
    rows, columns = lowest.shape
    touched, climbed = np.zeros(lowest.shape, np.bool_), np.zeros(lowest.shape, np.bool_)
    queued = np.zeros(lowest.shape, np.int32)  # the last round in which a cell was queued
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
            nearest, base = REACH_CELLS * REACH_CELLS + 1, 0.0
            for away, down, right in NEIGHBOURS:
                if away > nearest:
                    break
                i, j = r + down, c + right
                if 0 <= i < rows and 0 <= j < columns and touched[i, j]:
                    if away < nearest or lowest[i, j] < base:
                        base = lowest[i, j]
                    nearest = away
            if nearest <= REACH_CELLS * REACH_CELLS and (lowest[r, c] - base <= STEP_M + slope * np.sqrt(nearest)):
                new.append((r, c))
        waiting.clear()
        for r, c in new:
            touched[r, c] = climbed[r, c] = True
        for r, c in new:
            for i in range(max(r - REACH_CELLS, 0), min(r + REACH_CELLS + 1, rows)):
                for j in range(max(c - REACH_CELLS, 0), min(c + REACH_CELLS + 1, columns)):
                    if lowest[i, j] != UNOBSERVED and not touched[i, j] and queued[i, j] < turn:
                        queued[i, j] = turn
                        waiting.append((i, j))
    return climbed
