"""DBSCAN cluster by cluster: each grows from a core point to all points within eps."""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.clustering.cells import find_core_points, sort_into_cells

# Mean number of points around a point above which DBSCAN by cells is faster.
MAX_MEAN_NEIGHBOURS = 500


def dbscan_by_growing(xyz: np.ndarray, eps: float, min_samples: int) -> np.ndarray | None:
    """Cluster points (N, 3) float32, N > 0, by growing one cluster after the other.

    No pairs are stored, so memory is linear in the number of points.

    Returns:
        (N,) int32 labels as from dbscan.dbscan; None if the points are too dense for this method.
    """
    cells = sort_into_cells(xyz, eps)
    if np.diff(cells.start) @ cells.size > MAX_MEAN_NEIGHBOURS * len(xyz):
        return None
    core = find_core_points(cells, np.full(len(xyz), eps * eps), float(min_samples), np.inf)[0]
    labels = np.empty(len(xyz), np.int32)
    labels[cells.order] = _grow_clusters(cells, np.ascontiguousarray(cells.xyz.T), core, eps * eps)
    return labels


@njit(cache=True, nogil=True)
def _grow_clusters(cells, points, core, eps2):
    """Grow the clusters; return (N,) labels in the order of the cells.

    Clusters start at core points in the order of the input. They are therefore numbered by their
    first core point, and a border point joins the first cluster that reaches it.

    items holds the points of each cell in three parts: core points without a cluster (up to
    core_end[a]), points with a cluster, and other points without a cluster (from rest_begin[a] on).
    """
    n, start = len(points), cells.start
    cell, items, position = np.empty(n, np.int32), np.arange(n), np.empty(n, np.int64)
    core_end, rest_begin = start[:-1].copy(), start[:-1].copy()
    for a in range(len(core_end)):
        for i in range(start[a], start[a + 1]):
            cell[i] = a
            if core[i]:
                items[core_end[a]], items[i] = i, items[core_end[a]]
                core_end[a] += 1
        rest_begin[a] = core_end[a]
    for m in range(n):
        position[items[m]] = m
    grid_index, stack = np.empty(n, np.int64), np.empty(n, np.int64)
    for k in range(n):
        grid_index[cells.order[k]] = k
    labels, count = np.zeros(n, np.int32), 0
    for row in range(n):
        seed = grid_index[row]
        if not core[seed] or labels[seed]:
            continue
        count += 1
        labels[seed], stack[0], stack_size = count, seed, 1
        _swap(items, position, position[seed], core_end[cell[seed]] - 1)
        core_end[cell[seed]] -= 1
        while stack_size:
            stack_size -= 1
            i = stack[stack_size]
            x, y, z, a = points[i, 0], points[i, 1], points[i, 2], cell[i]
            for k in range(cells.ranges[a]):
                for b in range(cells.low[a, k], cells.high[a, k]):
                    for m in range(core_end[b] - 1, start[b] - 1, -1):
                        j = items[m]
                        dx, dy, dz = x - points[j, 0], y - points[j, 1], z - points[j, 2]
                        if dx * dx + dy * dy + dz * dz <= eps2:
                            labels[j], stack[stack_size] = count, j
                            stack_size += 1
                            core_end[b] -= 1
                            _swap(items, position, m, core_end[b])
                    for m in range(rest_begin[b], start[b + 1]):
                        j = items[m]
                        dx, dy, dz = x - points[j, 0], y - points[j, 1], z - points[j, 2]
                        if dx * dx + dy * dy + dz * dz <= eps2:
                            labels[j] = count
                            _swap(items, position, m, rest_begin[b])
                            rest_begin[b] += 1
    return labels


@njit(cache=True, nogil=True)
def _swap(items, position, m, k):
    i, j = items[m], items[k]
    items[m], items[k], position[i], position[j] = j, i, k, m
