"""Points sorted into cells as wide as a reach, each with the ranges of points around it."""

from __future__ import annotations

from collections import namedtuple

import numpy as np
from numba import njit

from lidar_perception.clustering.grid import grid

# Points sorted into cells: their rows order (N,), float64 xyz (3, N), and start (C+1,) the first
# of each cell. All within `reach` of cell a are in the cells low[a, k] to high[a, k] - 1 for
# k < ranges[a], first those of its own column; these hold size[a] points.
Cells = namedtuple("Cells", "reach order xyz start ranges size low high")


def cells_of(xyz: np.ndarray, reach: float) -> Cells:
    """Sort (N, 3) float32 points into cells, at least one."""
    # A hair over reach, so that rounding never puts two neighbours more than a cell apart; at
    # least a micrometre, as thresholds may be 0.
    order, *rest = grid(xyz, max(reach, 1e-6) * (1.0 + 1e-6), 1)
    return Cells(reach, order, xyz[order].T.astype(np.float64, order="C"), rest[0], *_ranges(*rest))


@njit(cache=True, nogil=True)
def _ranges(start, cell_z, column_start, neighbours):
    columns, half = neighbours.shape
    low = np.empty((len(cell_z), 2 * half - 1), np.int32)
    high, ranges, size = np.empty_like(low), np.zeros_like(cell_z), np.zeros_like(cell_z)
    for side in range(2 * half - 1):
        for c in range(columns):
            own, other = c, neighbours[c, side % half + side // half]
            if other < 0:
                continue
            if side >= half:  # each pair of columns from the other side
                own, other = other, c
            begin = end = column_start[other]
            last = column_start[other + 1]
            for a in range(column_start[own], column_start[own + 1]):
                while begin < last and cell_z[begin] < cell_z[a] - 1:
                    begin += 1
                end = max(end, begin)
                while end < last and cell_z[end] <= cell_z[a] + 1:
                    end += 1
                if begin < end:
                    low[a, ranges[a]], high[a, ranges[a]] = begin, end
                    ranges[a] += 1
                    size[a] += start[end] - start[begin]
    return ranges, size, low, high


@njit(cache=True, nogil=True)
def gather(cells, a, out):
    """Copy the points around cell a side by side, for long loops. Here and below unsigned indices
    tell the compiler that none counts from the end: only then does it make vector loops."""
    put = np.uint64(0)
    for k in range(cells.ranges[a]):
        for j in range(np.uint64(cells.start[cells.low[a, k]]),
                       np.uint64(cells.start[cells.high[a, k]])):
            for axis in range(3):
                out[axis, put] = cells.xyz[axis, j]
            put += np.uint64(1)
