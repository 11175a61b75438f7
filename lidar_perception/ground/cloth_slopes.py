"""Ground that climbs too steeply for the cloth (after Zhang et al., Remote Sensing 2016, 2.5)."""

from __future__ import annotations

import numpy as np
from numba import njit

UNOBSERVED = np.float32(np.inf)
REACH_CELLS, STEP_M = 6, 0.05  # maximum gap, and maximum step in height, over which the ground continues
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

    Some roads begin to climb more steeply than the cloth can bend between two rings of points. The
    lowest points of objects on the road lie above its slope, so objects are not included.

    A cell continues the ground if its lowest point is at most STEP_M plus `slope` per cell above
    the lowest point of the nearest ground cell, at most REACH_CELLS away (of equally near cells,
    the lowest is used). All cells of a round use the result of the previous round, so the result
    does not depend on the order of the cells.

    Args:
        lowest: (R, C) lowest point of each cell in metres, UNOBSERVED for cells without points.
        height: (R, C) height of the cloth, which touches a cell whose lowest point is within
            `threshold`.
        slope: rise per cell in metres.

    Returns:
        (R, C) bool, True for these cells; False for cells that the cloth touches.
    """
    rows, columns = lowest.shape
    is_ground, is_climbing = np.zeros(lowest.shape, np.bool_), np.zeros(lowest.shape, np.bool_)
    queued_round = np.zeros(lowest.shape, np.int32)  # the last round in which a cell was queued
    candidates = []
    for r in range(rows):
        for c in range(columns):
            if lowest[r, c] != UNOBSERVED:
                is_ground[r, c] = lowest[r, c] - height[r, c] <= threshold
                if not is_ground[r, c]:
                    candidates.append((r, c))
    round_number = 0
    while len(candidates):
        round_number += 1
        accepted_cells = []
        for r, c in candidates:
            nearest2, base_height = REACH_CELLS * REACH_CELLS + 1, 0.0
            for distance2, row_offset, column_offset in NEIGHBOURS:
                if distance2 > nearest2:
                    break
                i, j = r + row_offset, c + column_offset
                if 0 <= i < rows and 0 <= j < columns and is_ground[i, j]:
                    if distance2 < nearest2 or lowest[i, j] < base_height:
                        base_height = lowest[i, j]
                    nearest2 = distance2
            if nearest2 <= REACH_CELLS * REACH_CELLS and (
                lowest[r, c] - base_height <= STEP_M + slope * np.sqrt(nearest2)
            ):
                accepted_cells.append((r, c))
        candidates.clear()
        for r, c in accepted_cells:
            is_ground[r, c] = is_climbing[r, c] = True
        for r, c in accepted_cells:
            for i in range(max(r - REACH_CELLS, 0), min(r + REACH_CELLS + 1, rows)):
                for j in range(max(c - REACH_CELLS, 0), min(c + REACH_CELLS + 1, columns)):
                    if lowest[i, j] != UNOBSERVED and not is_ground[i, j] and queued_round[i, j] < round_number:
                        queued_round[i, j] = round_number
                        candidates.append((i, j))
    return is_climbing
