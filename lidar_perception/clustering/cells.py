"""Points sorted into cubic cells as wide as a search radius ("reach").

Each cell stores the ranges of cells that contain all neighbours of its points.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np
from numba import njit

from lidar_perception.clustering.grid import build_grid, take_columns

BLOCK = 32  # distances per block: few enough to stop early, many enough for vectorised loops

# N points sorted into C cells. order (N,) are their rows in the input, xyz (3, N) their float64
# coordinates; start (C + 1,) is the index of the first point of each cell. All neighbours within
# `reach` of cell a are in the cells low[a, k] .. high[a, k] - 1 for k < ranges[a]; k = 0 is the
# cell's own column. size[a] is the number of points in these cells.
Cells = namedtuple("Cells", "reach order xyz start ranges size low high")


def sort_into_cells(xyz: np.ndarray, reach: float) -> Cells:
    """Sort points (N, 3) float32, N > 0, into cells of width `reach` in metres."""
    # Slightly more than reach, so that rounding never puts two neighbours more than one cell
    # apart; at least a micrometre, because thresholds may be 0.
    order, *rest = build_grid(xyz, max(reach, 1e-6) * (1.0 + 1e-6), 1)
    return Cells(reach, order, take_columns(xyz, order), rest[0], *_find_ranges(*rest))


def compute_mean_neighbourhood_size(cells: Cells) -> float:
    """Return the mean number of points in the cells around a point."""
    return float(np.diff(cells.start) @ cells.size) / len(cells.order)


# S points that represent the points of C cells. xyz (3, S) float64 are their coordinates, start
# (C + 1,) is the index of the first point of each cell, weight (C,) the number of points that each
# sampled point of a cell represents. Further rows in the cells' xyz are sampled too.
Sample = namedtuple("Sample", "xyz start weight")


def sample_cells(cells: Cells, max_work: int) -> Sample:
    """Sample the points of each cell, at least one per cell.

    The limit per cell is halved until there are at most `max_work` distances from all points to the
    samples of their neighbourhoods. Points are chosen by a hash of their coordinates, so the result
    does not depend on the order of the points or on the rest of the cloud.
    """
    sizes = np.diff(cells.start)
    limit = int(sizes.max())
    while limit > 1 and _count_distances(cells, np.minimum(sizes, limit)) > max_work:
        limit //= 2
    sample_sizes = np.minimum(sizes, limit)
    start = np.concatenate([[0], np.cumsum(sample_sizes)])
    bits = cells.xyz[:3].astype(np.float32).view(np.uint32).astype(np.uint64)
    return Sample(_take_sample(cells, _mix_bits(bits), start), start, sizes / sample_sizes)


def _mix_bits(bits: np.ndarray) -> np.ndarray:
    """Hash each column of (3, N) uint64 to one uint64 (splitmix64)."""
    hashes = bits[0] << np.uint64(32) | bits[1]
    for increment in (bits[2], np.uint64(0)):
        hashes = (hashes ^ hashes >> np.uint64(30)) * np.uint64(0xBF58476D1CE4E5B9)
        hashes = (hashes ^ hashes >> np.uint64(27)) * np.uint64(0x94D049BB133111EB) + increment
    return hashes ^ hashes >> np.uint64(31)


@njit(cache=True, nogil=True)
def _count_distances(cells, sample_sizes):
    """Count the distances from all points to the samples of the cells around them.

    sample_sizes (C,) is the number of sampled points of each cell.
    """
    cumulative, total = np.zeros(len(sample_sizes) + 1), 0.0
    for a in range(len(sample_sizes)):
        cumulative[a + 1] = cumulative[a] + sample_sizes[a]
    for a in range(len(sample_sizes)):
        for k in range(cells.ranges[a]):
            total += (cells.start[a + 1] - cells.start[a]) * (
                cumulative[cells.high[a, k]] - cumulative[cells.low[a, k]]
            )
    return total


@njit(cache=True, nogil=True)
def _take_sample(cells, keys, start):
    points = np.empty((len(cells.xyz), start[-1]))
    for a in range(len(start) - 1):
        first = cells.start[a]
        rows = np.argsort(keys[first : cells.start[a + 1]], kind="mergesort")
        count = start[a + 1] - start[a]
        for k in range(count):  # evenly spaced, so that coincident points are not over-represented
            points[:, start[a] + k] = cells.xyz[:, first + rows[k * len(rows) // count]]
    return points


@njit(cache=True, nogil=True)
def gather_sample(cells, sample, a):
    """Return the sample of the cells around cell a: xyz (3 or more, M) and weight (M,)."""
    size = 0
    for k in range(cells.ranges[a]):
        size += sample.start[cells.high[a, k]] - sample.start[cells.low[a, k]]
    points, weight, next_slot = np.empty((len(sample.xyz), size)), np.empty(size), 0
    for k in range(cells.ranges[a]):
        for b in range(cells.low[a, k], cells.high[a, k]):
            for j in range(sample.start[b], sample.start[b + 1]):
                points[:, next_slot], weight[next_slot] = sample.xyz[:, j], sample.weight[b]
                next_slot += 1
    return points, weight


@njit(cache=True, nogil=True)
def _find_ranges(start, cell_z, column_start, neighbours):
    columns, half_count = neighbours.shape
    low = np.empty((len(cell_z), 2 * half_count - 1), np.int32)
    high, ranges, size = np.empty_like(low), np.zeros_like(cell_z), np.zeros_like(cell_z)
    for c in range(columns):
        _add_ranges(start, cell_z, column_start, c, c, low, high, ranges, size)
    for c in range(columns):
        for k in range(1, half_count):
            other = neighbours[c, k]
            if other >= 0:
                _add_ranges(start, cell_z, column_start, c, other, low, high, ranges, size)
                _add_ranges(start, cell_z, column_start, other, c, low, high, ranges, size)
    return ranges, size, low, high


@njit(cache=True, nogil=True)
def _add_ranges(start, cell_z, column_start, column, other, low, high, ranges, size):
    """Add to each cell of `column` the range of cells of column `other` at most one level apart."""
    begin = end = column_start[other]
    last = column_start[other + 1]
    for a in range(column_start[column], column_start[column + 1]):
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
def gather_neighbourhood(cells, a, out):
    """Copy the points of the cells around cell a into the array out (3, M), contiguously.

    Here and below, the loops use unsigned indices because Numba vectorises them only if no index
    can be negative.
    """
    next_slot = np.uint64(0)
    for k in range(cells.ranges[a]):
        for j in range(np.uint64(cells.start[cells.low[a, k]]), np.uint64(cells.start[cells.high[a, k]])):
            for axis in range(3):
                out[axis, next_slot] = cells.xyz[axis, j]
            next_slot += np.uint64(1)


@njit(cache=True, nogil=True)
def find_core_points(cells, reach2, min_points, budget):
    """Find the points with at least min_points points within reach, themselves included.

    Args:
        reach2: (N,) squared reach of each point, in the order of the cells; at most cells.reach
            squared.
        min_points: minimum number of points as a float, which can have a fraction.
        budget: maximum number of distances, at which the search stops.

    Returns:
        is_core (N,) bool in the order of the cells; the remaining budget, negative if the search
        stopped early.
    """
    is_core, neighbours = np.zeros(len(reach2), np.bool_), np.empty((3, cells.size.max()))
    for a in range(len(cells.size)):
        if budget < 0:
            break
        budget -= cells.size[a]
        gather_neighbourhood(cells, a, neighbours)
        for i in range(cells.start[a], cells.start[a + 1]):
            px, py, pz = cells.xyz[0, i], cells.xyz[1, i], cells.xyz[2, i]
            count, begin, size = 0, 0, cells.size[a]
            while count < min_points and begin < size:
                for j in range(np.uint64(begin), np.uint64(min(begin + BLOCK, size))):
                    dx, dy, dz = px - neighbours[0, j], py - neighbours[1, j], pz - neighbours[2, j]
                    is_near = 1 if dx * dx + dy * dy + dz * dz <= reach2[i] else 0
                    count += is_near
                begin += BLOCK
            budget -= begin
            is_core[i] = count >= min_points
    return is_core, budget
