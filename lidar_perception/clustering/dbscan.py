"""Exact DBSCAN on a grid, and the distance-aware DBSCAN of paper A.

Ester et al., KDD 1996. The grid follows one idea: with cells of side eps / sqrt(3) all points of
a cell are neighbours of each other. A cell with min_samples points is all core, the core points
of a cell always share a cluster, and so clusters are joined cell by cell: two cells are joined at
their first pair of core points within eps. Memory is O(N), whatever the density.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.geometry import horizontal_range
from lidar_perception.params import DbscanParams


def distance_aware_dbscan(xyz: np.ndarray, params: DbscanParams = DbscanParams()) -> np.ndarray:
    """(N,) int32 cluster ids of points (N, 3) float32 in the LiDAR frame; 0 is noise.

    Each band of horizontal range [range_limits[i-1], range_limits[i]) is clustered by itself with
    eps[i]; ids go on from band to band (paper A, Section 3.3).
    """
    band = np.searchsorted(np.asarray(params.range_limits), horizontal_range(xyz), side="right")
    labels = np.zeros(len(xyz), np.int32)
    last = 0
    for i, eps in enumerate(params.eps):
        members = np.flatnonzero(band == i)
        if len(members) < params.min_samples:
            continue
        found = dbscan(xyz.take(members, axis=0), eps, params.min_samples)
        labels[members] = np.where(found > 0, found + last, 0)
        last += int(found.max(initial=0))
    return labels


def dbscan(xyz: np.ndarray, eps: float, min_samples: int) -> np.ndarray:
    """(N,) int32 labels of finite points (N, 3): 0 noise, clusters 1..K.

    The labels are those of scikit-learn's DBSCAN plus one, border points included: clusters are
    numbered by their first core point, and a border point between clusters goes to the first.
    """
    if len(xyz) == 0:
        return np.zeros(0, np.int32)
    # A hair under eps / sqrt(3), so that rounding never puts two far points into one cell.
    side = eps / np.sqrt(3.0) * (1.0 - 1e-6)
    xyz = np.ascontiguousarray(xyz, np.float32)
    order, start, cell_z, column_start, neighbours = _grid(xyz, side)
    first, second = _neighbour_cells(cell_z, column_start, neighbours)
    x, y, z = np.ascontiguousarray(xyz.T[:, order], np.float64)
    core = _core_points(x, y, z, start, first, second, eps * eps, min_samples)
    return _labels(x, y, z, order, start, first, second, core, eps * eps)


@njit(cache=True)
def _hash(ix, iy, mask):
    return (ix * np.int64(73856093) ^ iy * np.int64(19349663)) & mask


@njit(cache=True)
def _grid(xyz, side):
    """Sort points by cell: columns of cells with the same x and y, in each column ascending z.

    Returns order (N,), cell_start (C+1,), cell_z (C,), column_start (M+1,) first cell of each
    column, and neighbours (M, 13): the column itself and twelve of the 24 around it, -1 if empty;
    the other twelve see this column as theirs.
    """
    n = len(xyz)
    size = 16
    while size < 2 * n:
        size *= 2
    mask = np.int64(size - 1)
    table = np.full(size, -1, np.int32)
    column_x, column_y = np.empty(n, np.int64), np.empty(n, np.int64)
    column = np.empty(n, np.int32)
    z = np.empty(n, np.int64)
    columns = 0
    scale = 1.0 / side
    for i in range(n):
        ix = np.int64(np.floor(np.float64(xyz[i, 0]) * scale))
        iy = np.int64(np.floor(np.float64(xyz[i, 1]) * scale))
        z[i] = np.int64(np.floor(np.float64(xyz[i, 2]) * scale))
        slot = _hash(ix, iy, mask)
        while True:
            c = table[slot]
            if c < 0:
                c = columns
                table[slot] = c
                column_x[c], column_y[c] = ix, iy
                columns += 1
                break
            if column_x[c] == ix and column_y[c] == iy:
                break
            slot = (slot + 1) & mask
        column[i] = c
    order = _stable_order(column, columns, _order_by_height(z))

    cell_start, cell_z = np.empty(n + 1, np.int64), np.empty(n, np.int64)
    column_start = np.empty(columns + 1, np.int64)
    cells, last_column = 0, np.int32(-1)
    for k in range(n):
        i = order[k]
        if column[i] != last_column or z[i] != cell_z[cells - 1]:
            if column[i] != last_column:
                last_column = column[i]
                column_start[last_column] = cells
            cell_start[cells], cell_z[cells] = k, z[i]
            cells += 1
    cell_start[cells], column_start[columns] = n, cells

    neighbours = np.empty((columns, 13), np.int64)
    for c in range(columns):
        neighbours[c, 0] = c
        k = 1
        for dx in range(3):
            for dy in range(-2, 3):
                if dx == 0 and dy <= 0:
                    continue
                ix, iy = column_x[c] + dx, column_y[c] + dy
                slot = _hash(ix, iy, mask)
                while True:
                    other = table[slot]
                    if other < 0 or (column_x[other] == ix and column_y[other] == iy):
                        break
                    slot = (slot + 1) & mask
                neighbours[c, k] = other
                k += 1
    return order, cell_start[:cells + 1], cell_z[:cells], column_start, neighbours


@njit(cache=True)
def _order_by_height(z):
    low, high = z.min(), z.max()
    if high - low > 8 * len(z) + 4096:  # far outliers: too many levels to count
        return np.argsort(z, kind="mergesort")
    return _stable_order((z - low).astype(np.int32), high - low + 1, np.arange(len(z)))


@njit(cache=True)
def _stable_order(keys, count, first):
    """`first` reordered by keys 0..count-1; equal keys keep their order. Counting sort."""
    start = np.zeros(count + 1, np.int64)
    for key in keys:
        start[key + 1] += 1
    for i in range(count):
        start[i + 1] += start[i]
    order = np.empty(len(keys), np.int64)
    for i in first:
        order[start[keys[i]]] = i
        start[keys[i]] += 1
    return order


@njit(cache=True)
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
                first, second = _grown(first, count, capacity), _grown(second, count, capacity)
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


@njit(cache=True)
def _grown(values, count, capacity):
    grown = np.empty(capacity, values.dtype)
    grown[:count] = values[:count]
    return grown


@njit(cache=True)
def _near(x, y, z, i, j, eps2):
    dx, dy, dz = x[i] - x[j], y[i] - y[j], z[i] - z[j]
    return dx * dx + dy * dy + dz * dz <= eps2


@njit(cache=True)
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
        if sparse[a]:
            sparse[a] = _count(x, y, z, start, a, b, eps2, min_samples, found)
        if sparse[b]:
            sparse[b] = _count(x, y, z, start, b, a, eps2, min_samples, found)
    return found >= min_samples


@njit(cache=True)
def _count(x, y, z, start, a, b, eps2, enough, found):
    """Add to found, for the points of cell a, their neighbours in cell b, until enough.
    True if a point of cell a still has too few."""
    wanting = False
    for i in range(start[a], start[a + 1]):
        count = found[i]
        if count < enough:
            for j in range(start[b], start[b + 1]):
                if _near(x, y, z, i, j, eps2):
                    count += 1
                    if count == enough:
                        break
            found[i] = count
            wanting |= count < enough
    return wanting


@njit(cache=True)
def _root(parent, c):
    while parent[c] != c:
        parent[c] = parent[parent[c]]
        c = parent[c]
    return c


@njit(cache=True)
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


@njit(cache=True)
def _touch(x, y, z, core, extents, start, a, b, eps2):
    """True if a core point of cell a lies within eps of a core point of cell b."""
    box = extents[b]
    for i in range(start[a], start[a + 1]):
        # Far from all of cell b at once: keeps two dense cells that do not touch linear.
        dx = max(box[0] - x[i], 0.0, x[i] - box[3])
        dy = max(box[1] - y[i], 0.0, y[i] - box[4])
        dz = max(box[2] - z[i], 0.0, z[i] - box[5])
        if core[i] and dx * dx + dy * dy + dz * dz <= eps2:
            for j in range(start[b], start[b + 1]):
                if core[j] and _near(x, y, z, i, j, eps2):
                    return True
    return False


@njit(cache=True)
def _labels(x, y, z, order, start, first, second, core, eps2):
    n, cells = len(x), len(start) - 1
    cores = np.zeros(cells, np.int32)
    cell_of = np.empty(n, np.int32)
    grid_place = np.empty(n, np.int32)
    for c in range(cells):
        for k in range(start[c], start[c + 1]):
            cores[c] += core[k]
            cell_of[k] = c
            grid_place[order[k]] = k

    parent = np.arange(cells).astype(np.int32)
    extents = _core_extents(x, y, z, start, core)
    for p in range(len(first)):
        a, b = first[p], second[p]
        if cores[a] and cores[b]:
            root_a, root_b = _root(parent, a), _root(parent, b)
            if root_a != root_b and _touch(x, y, z, core, extents, start, a, b, eps2):
                parent[max(root_a, root_b)] = min(root_a, root_b)

    # Clusters are numbered by their first core point in the order of the input.
    cluster = np.zeros(cells, np.int32)
    count = 0
    for i in range(n):
        k = grid_place[i]
        if core[k]:
            root = _root(parent, cell_of[k])
            if cluster[root] == 0:
                count += 1
                cluster[root] = count
    for c in range(cells):
        cluster[c] = cluster[_root(parent, c)] if cores[c] else 0

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


@njit(cache=True)
def _adopt(x, y, z, order, start, a, b, core, label, labels, eps2):
    """Give the border points of cell a that the core of cell b touches b's label, if lower."""
    for i in range(start[a], start[a + 1]):
        mine = labels[order[i]]
        if not core[i] and (mine == 0 or mine > label):
            for j in range(start[b], start[b + 1]):
                if core[j] and _near(x, y, z, i, j, eps2):
                    labels[order[i]] = label
                    break
