"""DBSCAN pair by pair, for sparse points: each pair within eps is found once and kept."""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.clustering.grid import grid, grown, in_order, near, number_clusters, root

# Distances to compute a point, at most: beyond this, going by cells is faster and takes less
# memory.
BUDGET = 40


def dbscan_by_pairs(xyz: np.ndarray, eps: float, min_samples: int) -> np.ndarray | None:
    """(N,) int32 labels of points (N, 3) float32, as dbscan.dbscan; None if they are too dense."""
    # A hair over eps, so that rounding never puts two neighbours more than a column apart.
    order, start, cell_z, column_start, neighbours = grid(xyz, eps * (1.0 + 1e-6), 1)
    if _distances(start, cell_z, column_start, neighbours) > BUDGET * len(xyz) + 100_000:
        return None
    x, y, z = in_order(xyz, order)
    found, first, second = _pairs(x, y, z, start, cell_z, column_start, neighbours, eps * eps)
    return _labels(order, found >= min_samples, first, second)


@njit(cache=True, nogil=True)
def _distances(start, cell_z, column_start, neighbours):
    """How many distances _pairs would compute."""
    total = 0
    for c in range(len(column_start) - 1):
        for k in range(neighbours.shape[1]):
            other = neighbours[c, k]
            if other < 0:
                continue
            begin, end = column_start[other], column_start[other]
            last = column_start[other + 1]
            for a in range(column_start[c], column_start[c + 1]):
                while begin < last and cell_z[begin] < cell_z[a] - 1:
                    begin += 1
                end = max(end, begin)
                while end < last and cell_z[end] <= cell_z[a] + 1:
                    end += 1
                total += (start[a + 1] - start[a]) * (start[end] - start[begin])
    return total


@njit(cache=True, nogil=True)
def _pairs(x, y, z, start, cell_z, column_start, neighbours, eps2):
    """found (N,): points within eps of each, itself included; first (P,), second (P,): the pairs,
    each once."""
    capacity = 8 * len(x) + 16
    first, second = np.empty(capacity, np.int32), np.empty(capacity, np.int32)
    found = np.ones(len(x), np.int32)
    count = 0
    for c in range(len(column_start) - 1):
        for k in range(neighbours.shape[1]):
            other = neighbours[c, k]
            if other < 0:
                continue
            begin, end = column_start[other], column_start[other]
            last = column_start[other + 1]
            for a in range(column_start[c], column_start[c + 1]):
                while begin < last and cell_z[begin] < cell_z[a] - 1:
                    begin += 1
                end = max(end, begin)
                while end < last and cell_z[end] <= cell_z[a] + 1:
                    end += 1
                low, high = start[begin], start[end]
                work = (start[a + 1] - start[a]) * (high - low)
                if count + work > capacity:
                    capacity = 2 * (count + work)
                    first, second = grown(first, count, capacity), grown(second, count, capacity)
                for i in range(start[a], start[a + 1]):
                    for j in range(max(low, i + 1) if k == 0 else low, high):
                        if near(x, y, z, i, j, eps2):
                            found[i] += 1
                            found[j] += 1
                            first[count], second[count] = i, j
                            count += 1
    return found, first[:count], second[:count]


@njit(cache=True, nogil=True)
def _labels(order, core, first, second):
    n = len(order)
    parent = np.arange(n).astype(np.int32)
    for p in range(len(first)):
        i, j = first[p], second[p]
        if core[i] and core[j]:
            a, b = root(parent, i), root(parent, j)
            if a != b:
                parent[max(a, b)] = min(a, b)

    cluster = number_clusters(order, core, np.arange(n), parent)
    # A border point goes to the first of the clusters that it touches.
    for p in range(len(first)):
        i, j = first[p], second[p]
        if core[i] != core[j]:
            if core[j]:
                i, j = j, i
            if cluster[j] == 0 or cluster[j] > cluster[i]:
                cluster[j] = cluster[i]
    labels = np.empty(n, np.int32)
    for k in range(n):
        labels[order[k]] = cluster[k]
    return labels
