"""DBSCAN cell by cell, for dense points: time and memory do not grow with the number of pairs.

With cells of side eps / sqrt(3) all points of a cell are neighbours of each other. A cell with
min_samples points is all core, the core points of a cell always share a cluster, and so clusters
are joined cell by cell: two cells at their first pair of core points within eps.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.clustering.grid import grid, grown, in_order, near, number_clusters, root
from lidar_perception.clustering.thinned import SLACK, patience, thinned


def dbscan_by_cells(xyz: np.ndarray, eps: float, min_samples: int) -> np.ndarray:
    """(N,) int32 labels of points (N, 3) float32, as dbscan.dbscan."""
    # A hair under eps / sqrt(3), so that rounding never puts two far points into one cell.
    order, start, cell_z, column_start, neighbours = grid(xyz, eps / np.sqrt(3.0) * (1.0 - 1e-6), 2)
    first, second = _neighbour_cells(cell_z, column_start, neighbours)
    x, y, z = in_order(xyz, order)
    core = _core_points(x, y, z, start, first, second, eps * eps, min_samples)
    cells, most_work = (x, y, z, start, first, second), patience(len(xyz))
    parent, work = _joined(*cells, core, eps * eps, most_work)
    if work > most_work:
        rows, few = np.flatnonzero(core), np.zeros(len(core), bool)
        few[rows[thinned(np.column_stack([x, y, z])[rows], eps, _cell_of(start)[rows])[0]]] = True
        parent, _ = _joined(*cells, few, (eps * (1 + SLACK)) ** 2, np.inf)
    return _labels(*cells, order, core, parent, eps * eps)


@njit(cache=True, nogil=True)
def _neighbour_cells(cell_z, column_start, neighbours):
    """first (P,), second (P,): pairs of distinct cells that may hold points within eps, once."""
    capacity = 12 * len(cell_z) + 16
    first, second = np.empty(capacity, np.int32), np.empty(capacity, np.int32)
    count = 0
    for c in range(len(column_start) - 1):
        for k in range(neighbours.shape[1]):
            other = neighbours[c, k]
            if other < 0:
                continue
            begin, end = column_start[other], column_start[other + 1]
            needed = count + 5 * (column_start[c + 1] - column_start[c])
            if needed > capacity:
                capacity = 2 * needed
                first, second = grown(first, count, capacity), grown(second, count, capacity)
            for a in range(column_start[c], column_start[c + 1]):
                low, high = cell_z[a] - 2, cell_z[a] + 2
                while begin < end and cell_z[begin] < low:
                    begin += 1
                b = max(begin, a + 1) if k == 0 else begin  # the column itself: each pair once
                while b < end and cell_z[b] <= high:
                    first[count], second[count] = a, b
                    count += 1
                    b += 1
    return first[:count], second[:count]


@njit(cache=True, nogil=True)
def _core_points(x, y, z, start, first, second, eps2, min_samples):
    """(N,) bool in grid order: at least min_samples points within eps, itself included."""
    cells = len(start) - 1
    found = np.empty(len(x), np.int32)
    sparse = np.empty(cells, np.bool_)
    for c in range(cells):
        size = start[c + 1] - start[c]
        sparse[c] = size < min_samples
        found[start[c]:start[c + 1]] = size
    for p in range(len(first)):
        a, b = first[p], second[p]
        if sparse[a] and sparse[b]:
            for i in range(start[a], start[a + 1]):
                for j in range(start[b], start[b + 1]):
                    within = near(x, y, z, i, j, eps2)
                    found[i] += within
                    found[j] += within
            sparse[a] = _wanting(found, start[a], start[a + 1], min_samples)
            sparse[b] = _wanting(found, start[b], start[b + 1], min_samples)
        elif sparse[a]:
            sparse[a] = _count(x, y, z, start, a, b, eps2, min_samples, found)
        elif sparse[b]:
            sparse[b] = _count(x, y, z, start, b, a, eps2, min_samples, found)
    return found >= min_samples


@njit(cache=True, nogil=True)
def _wanting(found, begin, end, enough):
    for i in range(begin, end):
        if found[i] < enough:
            return True
    return False


@njit(cache=True, nogil=True)
def _count(x, y, z, start, a, b, eps2, enough, found):
    """Add to found, for the points of cell a, their neighbours in cell b, until enough.
    True if a point of cell a still has too few."""
    wanting = False
    for i in range(start[a], start[a + 1]):
        count = found[i]
        if count < enough:
            for j in range(start[b], start[b + 1]):
                if near(x, y, z, i, j, eps2):
                    count += 1
                    if count == enough:
                        break
            found[i] = count
            wanting |= count < enough
    return wanting


@njit(cache=True, nogil=True)
def _core_extents(x, y, z, start, core):
    """(C, 6): low and high corner of each cell's core points; inf and -inf where it has none."""
    extents = np.empty((len(start) - 1, 6))
    extents[:, :3], extents[:, 3:] = np.inf, -np.inf
    for c in range(len(start) - 1):
        for i in range(start[c], start[c + 1]):
            if core[i]:
                extents[c, 0], extents[c, 3] = min(extents[c, 0], x[i]), max(extents[c, 3], x[i])
                extents[c, 1], extents[c, 4] = min(extents[c, 1], y[i]), max(extents[c, 4], y[i])
                extents[c, 2], extents[c, 5] = min(extents[c, 2], z[i]), max(extents[c, 5], z[i])
    return extents


@njit(cache=True, nogil=True)
def _touch(x, y, z, core, extents, start, a, b, eps2):
    """True if a core point of cell a lies within eps of a core point of cell b; and how many
    distances were computed."""
    box, work = extents[b], start[a + 1] - start[a]
    for i in range(start[a], start[a + 1]):
        # Far from all of cell b at once: keeps two dense cells that do not touch linear.
        dx = max(box[0] - x[i], 0.0, x[i] - box[3])
        dy = max(box[1] - y[i], 0.0, y[i] - box[4])
        dz = max(box[2] - z[i], 0.0, z[i] - box[5])
        if core[i] and dx * dx + dy * dy + dz * dz <= eps2:
            for j in range(start[b], start[b + 1]):
                if core[j] and near(x, y, z, i, j, eps2):
                    return True, work + j - start[b]
            work += start[b + 1] - start[b]
    return False, work


@njit(cache=True, nogil=True)
def _cell_of(start):
    """(N,) the cell of each point, in grid order."""
    cell_of = np.empty(start[-1], np.int32)
    for c in range(len(start) - 1):
        cell_of[start[c]:start[c + 1]] = c
    return cell_of


@njit(cache=True, nogil=True)
def _joined(x, y, z, start, first, second, core, eps2, most_work):
    """Union-find forest of the cells, and how many distances it took; if more than most_work, it
    is not complete."""
    parent, work = np.arange(len(start) - 1).astype(np.int32), 0
    extents = _core_extents(x, y, z, start, core)
    for p in range(len(first)):
        a, b = first[p], second[p]
        if extents[a, 0] <= extents[a, 3] and extents[b, 0] <= extents[b, 3]:  # both have cores
            root_a, root_b = root(parent, a), root(parent, b)
            if root_a != root_b:
                found, more = _touch(x, y, z, core, extents, start, a, b, eps2)
                if found:
                    parent[max(root_a, root_b)] = min(root_a, root_b)
                work += more
                if work > most_work:
                    break
    return parent, work


@njit(cache=True, nogil=True)
def _labels(x, y, z, start, first, second, order, core, parent, eps2):
    n, cells = len(x), len(start) - 1
    cores, cell_of = np.zeros(cells, np.int32), _cell_of(start)
    for c in range(cells):
        for k in range(start[c], start[c + 1]):
            cores[c] += core[k]

    cluster = number_clusters(order, core, cell_of, parent)
    # A point of a cell with core points belongs to their cluster, unless it is a border point
    # that a lower cluster touches too; points of other cells are noise until one touches them.
    labels = np.empty(n, np.int32)
    for c in range(cells):
        for k in range(start[c], start[c + 1]):
            labels[order[k]] = cluster[c]
    border = np.empty(cells, np.bool_)
    for c in range(cells):
        border[c] = cores[c] < start[c + 1] - start[c]
    for p in range(len(first)):
        a, b = first[p], second[p]
        if border[a] and cluster[b] and cluster[a] != cluster[b]:
            _adopt(x, y, z, order, start, a, b, core, cluster[b], labels, eps2)
        if border[b] and cluster[a] and cluster[a] != cluster[b]:
            _adopt(x, y, z, order, start, b, a, core, cluster[a], labels, eps2)
    return labels


@njit(cache=True, nogil=True)
def _adopt(x, y, z, order, start, a, b, core, label, labels, eps2):
    """Give the border points of cell a that the core of cell b touches b's label, if lower."""
    for i in range(start[a], start[a + 1]):
        mine = labels[order[i]]
        if not core[i] and (mine == 0 or mine > label):
            for j in range(start[b], start[b + 1]):
                if core[j] and near(x, y, z, i, j, eps2):
                    labels[order[i]] = label
                    break
