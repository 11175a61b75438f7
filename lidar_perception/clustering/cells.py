"""Points sorted into cells as wide as a reach, each with the ranges of points around it."""

from __future__ import annotations

from collections import namedtuple

import numpy as np
from numba import njit

from lidar_perception.clustering.grid import grid, in_order

BLOCK = 32  # distances at a time: few enough to stop early, many enough for vector loops

# Points sorted into cells: their rows order (N,), float64 xyz (3, N), and start (C+1,) the first
# of each cell. All within `reach` of cell a are in the cells low[a, k] to high[a, k] - 1 for
# k < ranges[a], first those of its own column; these hold size[a] points.
Cells = namedtuple("Cells", "reach order xyz start ranges size low high")


def cells_of(xyz: np.ndarray, reach: float) -> Cells:
    """Sort (N, 3) float32 points into cells, at least one."""
    # A hair over reach, so that rounding never puts two neighbours more than a cell apart; at
    # least a micrometre, as thresholds may be 0.
    order, *rest = grid(xyz, max(reach, 1e-6) * (1.0 + 1e-6), 1)
    return Cells(reach, order, in_order(xyz, order), rest[0], *_ranges(*rest))


def around(cells: Cells) -> float:
    """How many points lie in the cells around a point, in the mean."""
    return float(np.diff(cells.start) @ cells.size) / len(cells.order)


# Of each cell the points that stand for all of it: xyz (3, S) float64, start (C + 1,) and weight
# (C,), how many each stands for.
Sample = namedtuple("Sample", "xyz start weight")


def sample_of(cells: Cells, work: int) -> Sample:
    """So many points of each cell, at least one, that all around all points are at most `work`, as
    far as halves go. Chosen by their coordinates, as by chance: the order of the points, and what
    else there is in the cloud, makes no difference."""
    sizes = np.diff(cells.start)
    most = int(sizes.max())
    while most > 1 and _work(cells, np.minimum(sizes, most)) > work:
        most //= 2
    kept = np.minimum(sizes, most)
    start = np.concatenate([[0], np.cumsum(kept)])
    bits = cells.xyz.astype(np.float32).view(np.uint32).astype(np.uint64)
    return Sample(_chosen(cells, _mixed(bits), start), start, sizes / kept)


def _mixed(bits: np.ndarray) -> np.ndarray:
    """(N,) uint64 from (3, N): nearly a random number for each of different columns (splitmix)."""
    mixed = bits[0] << np.uint64(32) | bits[1]
    for more in (bits[2], np.uint64(0)):
        mixed = (mixed ^ mixed >> np.uint64(30)) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ mixed >> np.uint64(27)) * np.uint64(0x94D049BB133111EB) + more
    return mixed ^ mixed >> np.uint64(31)


@njit(cache=True, nogil=True)
def _work(cells, kept):
    """Distances from all points to the kept ones (C,) of the cells around them."""
    before, total = np.zeros(len(kept) + 1), 0.0
    for a in range(len(kept)):
        before[a + 1] = before[a] + kept[a]
    for a in range(len(kept)):
        for k in range(cells.ranges[a]):
            total += (cells.start[a + 1] - cells.start[a]) * (before[cells.high[a, k]]
                                                              - before[cells.low[a, k]])
    return total


@njit(cache=True, nogil=True)
def _chosen(cells, keys, start):
    out = np.empty((3, start[-1]))
    for a in range(len(start) - 1):
        first = cells.start[a]
        rows = np.argsort(keys[first:cells.start[a + 1]], kind="mergesort")
        kept = start[a + 1] - start[a]
        for k in range(kept):  # each so many-th: of places where many coincide as many as elsewhere
            out[:, start[a] + k] = cells.xyz[:, first + rows[k * len(rows) // kept]]
    return out


@njit(cache=True, nogil=True)
def gather_sample(cells, sample, a):
    """near (3, M) and weight (M,): the sample of the cells around cell a."""
    size = 0
    for k in range(cells.ranges[a]):
        size += sample.start[cells.high[a, k]] - sample.start[cells.low[a, k]]
    near, weight, put = np.empty((3, size)), np.empty(size), 0
    for k in range(cells.ranges[a]):
        for b in range(cells.low[a, k], cells.high[a, k]):
            for j in range(sample.start[b], sample.start[b + 1]):
                near[:, put], weight[put] = sample.xyz[:, j], sample.weight[b]
                put += 1
    return near, weight


@njit(cache=True, nogil=True)
def _ranges(start, cell_z, column_start, neighbours):
    columns, half = neighbours.shape
    low = np.empty((len(cell_z), 2 * half - 1), np.int32)
    high, ranges, size = np.empty_like(low), np.zeros_like(cell_z), np.zeros_like(cell_z)
    for c in range(columns):
        _add_ranges(start, cell_z, column_start, c, c, low, high, ranges, size)
    for c in range(columns):
        for k in range(1, half):
            other = neighbours[c, k]
            if other >= 0:
                _add_ranges(start, cell_z, column_start, c, other, low, high, ranges, size)
                _add_ranges(start, cell_z, column_start, other, c, low, high, ranges, size)
    return ranges, size, low, high


@njit(cache=True, nogil=True)
def _add_ranges(start, cell_z, column_start, own, other, low, high, ranges, size):
    """The cells of column `other` that are at most one higher or lower than each of column own."""
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


@njit(cache=True, nogil=True)
def crowded(cells, reach2, enough, work):
    """(N,) bool, cell by cell: at least `enough` points lie within reach, itself included. reach2
    (N,): the square of each point's own, at most that of the cells. And how much is left of the
    work, a number of distances; once it is below 0, the rest is not looked at."""
    leads, near = np.zeros(len(reach2), np.bool_), np.empty((3, cells.size.max()))
    for a in range(len(cells.size)):
        if work < 0:
            break
        work -= cells.size[a]
        gather(cells, a, near)
        for i in range(cells.start[a], cells.start[a + 1]):
            px, py, pz = cells.xyz[0, i], cells.xyz[1, i], cells.xyz[2, i]
            found, begin, size = 0, 0, cells.size[a]
            while found < enough and begin < size:
                for j in range(np.uint64(begin), np.uint64(min(begin + BLOCK, size))):
                    dx, dy, dz = px - near[0, j], py - near[1, j], pz - near[2, j]
                    one = 1 if dx * dx + dy * dy + dz * dz <= reach2[i] else 0
                    found += one
                begin += BLOCK
            work -= begin
            leads[i] = found >= enough
    return leads, work
