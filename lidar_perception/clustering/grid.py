"""Points sorted into a grid of columns of cells: the neighbourhoods of DBSCAN."""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.geometry import stable_order


@njit(cache=True, nogil=True)
def _hash(ix, iy, mask):
    return (ix * np.int64(73856093) ^ iy * np.int64(19349663)) & mask


@njit(cache=True, nogil=True)
def grid(xyz, side, reach):
    """Sort points by cell: columns of cells with the same x and y, in each column ascending z.

    Returns order (N,), cell_start (C+1,), cell_z (C,), column_start (M+1,) first cell of each
    column, and neighbours (M, H): the column itself and half of those up to `reach` columns away,
    -1 if empty; the other half see this column as theirs.
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
    order = stable_order(column, columns, _order_by_height(z))[0]

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

    neighbours = np.empty((columns, 1 + 2 * reach * (reach + 1)), np.int64)
    for c in range(columns):
        neighbours[c, 0] = c
        k = 1
        for dx in range(reach + 1):
            for dy in range(-reach, reach + 1):
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


@njit(cache=True, nogil=True)
def _order_by_height(z):
    low, high = z.min(), z.max()
    if high - low > 8 * len(z) + 4096:  # far outliers: too many levels to count
        return np.argsort(z, kind="mergesort")
    return stable_order((z - low).astype(np.int32), high - low + 1, np.arange(len(z)))[0]


@njit(cache=True, nogil=True)
def in_order(xyz, order):
    """(3, N) float64: the coordinates of the points (N, 3) in that order."""
    out = np.empty((3, len(order)))
    for k in range(len(order)):
        i = order[k]
        out[0, k], out[1, k], out[2, k] = xyz[i, 0], xyz[i, 1], xyz[i, 2]
    return out


@njit(cache=True, nogil=True)
def near(x, y, z, i, j, eps2):
    """True if points i and j are within eps; float64, as scikit-learn computes it."""
    dx, dy, dz = x[i] - x[j], y[i] - y[j], z[i] - z[j]
    return dx * dx + dy * dy + dz * dz <= eps2


@njit(cache=True, nogil=True)
def root(parent, i):
    """The representative of i in a union-find forest (path halving)."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True, nogil=True)
def grown(values, count, capacity):
    """values[:count] in a new array of that capacity."""
    new = np.empty(capacity, values.dtype)
    new[:count] = values[:count]
    return new


@njit(cache=True, nogil=True)
def number_clusters(order, core, owner, parent):
    """(S,) int32 cluster of each set of the union-find forest parent (S,), 0 for sets without a
    core point. Clusters are numbered 1..K by their first core point in the order of the input;
    order, core and owner (N,) are the input row, the core flag and the set of each grid point."""
    place = np.empty(len(order), np.int32)
    for k in range(len(order)):
        place[order[k]] = k
    cluster = np.zeros(len(parent), np.int32)
    count = 0
    for i in range(len(order)):
        k = place[i]
        if core[k]:
            top = root(parent, owner[k])
            if cluster[top] == 0:
                count += 1
                cluster[top] = count
    for s in range(len(parent)):
        cluster[s] = cluster[root(parent, s)]
    return cluster
