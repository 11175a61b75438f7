"""DBSCAN cell by cell, for dense points: time and memory do not grow with the number of pairs.

In a cell of side eps / sqrt(3) all points are neighbours. All points of a cell with min_samples
points are therefore core points, and the core points of a cell always share a cluster. Clusters
grow by joining cells: two cells are joined at their first pair of core points within eps.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.clustering.grid import (
    build_grid,
    enlarge_array,
    find_root,
    is_near,
    number_clusters,
    take_columns,
)
from lidar_perception.clustering.thinning import SLACK, compute_max_exact_distances, thin_points


def dbscan_by_cells(xyz: np.ndarray, eps: float, min_samples: int) -> np.ndarray:
    """Cluster points (N, 3) float32, N > 0; return (N,) int32 labels as from dbscan.dbscan."""
    # Slightly less than eps / sqrt(3), so that rounding never puts two distant points into one cell
    side = eps / np.sqrt(3.0) * (1.0 - 1e-6)
    order, start, cell_z, column_start, neighbours = build_grid(xyz, side, 2)
    first, second = _find_neighbour_cells(cell_z, column_start, neighbours)
    x, y, z = take_columns(xyz, order)
    core = _find_core_points(x, y, z, start, first, second, eps * eps, min_samples)
    cells, max_work = (x, y, z, start, first, second), compute_max_exact_distances(len(xyz))
    parent, work = _join_cells(*cells, core, eps * eps, max_work)
    if work > max_work:
        core_rows, kept_core = np.flatnonzero(core), np.zeros(len(core), bool)
        kept_rows, _ = thin_points(np.column_stack([x, y, z])[core_rows], eps, _list_cells(start)[core_rows])
        kept_core[core_rows[kept_rows]] = True
        parent, _ = _join_cells(*cells, kept_core, (eps * (1 + SLACK)) ** 2, np.inf)
    return _label_points(*cells, order, core, parent, eps * eps)


@njit(cache=True, nogil=True)
def _find_neighbour_cells(cell_z, column_start, neighbours):
    """List each pair of cells that can hold points within eps once, as first (P,) and second (P,)."""
    capacity = 12 * len(cell_z) + 16
    first, second = np.empty(capacity, np.int32), np.empty(capacity, np.int32)
    count = np.int64(0)
    for c in range(len(column_start) - 1):
        for k in range(neighbours.shape[1]):
            other = neighbours[c, k]
            if other < 0:
                continue
            begin, end = column_start[other], column_start[other + 1]
            required_capacity = count + 5 * (column_start[c + 1] - column_start[c])
            if required_capacity > capacity:
                capacity = 2 * required_capacity
                first = enlarge_array(first, count, capacity)
                second = enlarge_array(second, count, capacity)
            for a in range(column_start[c], column_start[c + 1]):
                low, high = cell_z[a] - 2, cell_z[a] + 2
                while begin < end and cell_z[begin] < low:
                    begin += 1
                b = max(begin, a + 1) if k == 0 else begin  # k = 0 is the column itself
                while b < end and cell_z[b] <= high:
                    first[count], second[count] = a, b
                    count += 1
                    b += 1
    return first[:count], second[:count]


@njit(cache=True, nogil=True)
def _find_core_points(x, y, z, start, first, second, eps2, min_samples):
    """Find the core points: those with at least min_samples points within eps, including themselves.

    Returns (N,) bool in grid order.
    """
    cells = len(start) - 1
    neighbour_counts = np.empty(len(x), np.int32)
    is_sparse = np.empty(cells, np.bool_)
    for c in range(cells):
        size = start[c + 1] - start[c]
        is_sparse[c] = size < min_samples
        neighbour_counts[start[c] : start[c + 1]] = size
    for p in range(len(first)):
        a, b = first[p], second[p]
        if is_sparse[a] and is_sparse[b]:
            for i in range(start[a], start[a + 1]):
                for j in range(start[b], start[b + 1]):
                    is_neighbour = is_near(x, y, z, i, j, eps2)
                    neighbour_counts[i] += is_neighbour
                    neighbour_counts[j] += is_neighbour
            is_sparse[a] = _has_sparse_point(neighbour_counts, start[a], start[a + 1], min_samples)
            is_sparse[b] = _has_sparse_point(neighbour_counts, start[b], start[b + 1], min_samples)
        elif is_sparse[a]:
            is_sparse[a] = _count_neighbours(x, y, z, start, a, b, eps2, min_samples, neighbour_counts)
        elif is_sparse[b]:
            is_sparse[b] = _count_neighbours(x, y, z, start, b, a, eps2, min_samples, neighbour_counts)
    return neighbour_counts >= min_samples


@njit(cache=True, nogil=True)
def _has_sparse_point(neighbour_counts, begin, end, min_samples):
    for i in range(begin, end):
        if neighbour_counts[i] < min_samples:
            return True
    return False


@njit(cache=True, nogil=True)
def _count_neighbours(x, y, z, start, a, b, eps2, min_samples, neighbour_counts):
    """Add the neighbours in cell b to neighbour_counts (N,) for the points of cell a.

    Counting stops at min_samples. Returns True if a point of cell a still has fewer.
    """
    is_sparse = False
    for i in range(start[a], start[a + 1]):
        count = neighbour_counts[i]
        if count < min_samples:
            for j in range(start[b], start[b + 1]):
                if is_near(x, y, z, i, j, eps2):
                    count += 1
                    if count == min_samples:
                        break
            neighbour_counts[i] = count
            is_sparse |= count < min_samples
    return is_sparse


@njit(cache=True, nogil=True)
def _find_core_extents(x, y, z, start, core):
    """Return the low and high corners (C, 6) of each cell's core points; inf and -inf if it has none."""
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
def _cells_touch(x, y, z, core, extents, start, a, b, eps2):
    """Check for core points of cells a and b within eps.

    Returns True if there are any, and the number of distances computed.
    """
    box, work = extents[b], start[a + 1] - start[a]
    for i in range(start[a], start[a + 1]):
        # A point far from the whole of cell b costs one distance, so that the time for two dense
        # cells that do not touch is linear.
        dx = max(box[0] - x[i], 0.0, x[i] - box[3])
        dy = max(box[1] - y[i], 0.0, y[i] - box[4])
        dz = max(box[2] - z[i], 0.0, z[i] - box[5])
        if core[i] and dx * dx + dy * dy + dz * dz <= eps2:
            for j in range(start[b], start[b + 1]):
                if core[j] and is_near(x, y, z, i, j, eps2):
                    return True, work + j - start[b]
            work += start[b + 1] - start[b]
    return False, work


@njit(cache=True, nogil=True)
def _list_cells(start):
    """Return the cell (N,) of each point, in grid order."""
    cell_of = np.empty(start[-1], np.int32)
    for c in range(len(start) - 1):
        cell_of[start[c] : start[c + 1]] = c
    return cell_of


@njit(cache=True, nogil=True)
def _join_cells(x, y, z, start, first, second, core, eps2, max_work):
    """Join the cells that share a cluster.

    Returns the union-find forest of the cells and the number of distances computed. If that exceeds
    max_work, the forest is incomplete.
    """
    parent, work = np.arange(len(start) - 1).astype(np.int32), 0
    extents = _find_core_extents(x, y, z, start, core)
    for p in range(len(first)):
        a, b = first[p], second[p]
        # Only cells with core points are joined.
        if extents[a, 0] <= extents[a, 3] and extents[b, 0] <= extents[b, 3]:
            root_a, root_b = find_root(parent, a), find_root(parent, b)
            if root_a != root_b:
                are_touching, distances = _cells_touch(x, y, z, core, extents, start, a, b, eps2)
                if are_touching:
                    parent[max(root_a, root_b)] = min(root_a, root_b)
                work += distances
                if work > max_work:
                    break
    return parent, work


@njit(cache=True, nogil=True)
def _label_points(x, y, z, start, first, second, order, core, parent, eps2):
    n, cells = len(x), len(start) - 1
    core_counts, cell_of = np.zeros(cells, np.int32), _list_cells(start)
    for c in range(cells):
        for k in range(start[c], start[c + 1]):
            core_counts[c] += core[k]

    cluster = number_clusters(order, core, cell_of, parent)
    # A point of a cell with core points belongs to their cluster, unless it is a border point that
    # a lower cluster touches too. Points of other cells are noise until a cluster touches them.
    labels = np.empty(n, np.int32)
    for c in range(cells):
        for k in range(start[c], start[c + 1]):
            labels[order[k]] = cluster[c]
    has_border_points = np.empty(cells, np.bool_)
    for c in range(cells):
        has_border_points[c] = core_counts[c] < start[c + 1] - start[c]
    for p in range(len(first)):
        a, b = first[p], second[p]
        if has_border_points[a] and cluster[b] and cluster[a] != cluster[b]:
            _adopt_border_points(x, y, z, order, start, a, b, core, cluster[b], labels, eps2)
        if has_border_points[b] and cluster[a] and cluster[a] != cluster[b]:
            _adopt_border_points(x, y, z, order, start, b, a, core, cluster[a], labels, eps2)
    return labels


@njit(cache=True, nogil=True)
def _adopt_border_points(x, y, z, order, start, a, b, core, label, labels, eps2):
    """Assign `label` to border points of cell a near a core point of cell b.

    Border points that already have a lower label keep it.
    """
    for i in range(start[a], start[a + 1]):
        current = labels[order[i]]
        if not core[i] and (current == 0 or current > label):
            for j in range(start[b], start[b + 1]):
                if core[j] and is_near(x, y, z, i, j, eps2):
                    labels[order[i]] = label
                    break
