"""Points sorted into a grid of columns of cells, and a union-find forest to join them."""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.geometry import counting_sort


@njit(cache=True, nogil=True)
def _hash(ix, iy, mask):
    return (ix * np.int64(73856093) ^ iy * np.int64(19349663)) & mask


@njit(cache=True, nogil=True)
def build_grid(xyz, side, reach):
    """Sort points (N, 3) by cell: columns of cells with equal x and y, in ascending z.

    Args:
        side: width of a cell in metres.
        reach: maximum distance of neighbouring columns, in cells.

    Returns:
        order (N,): row in xyz of each sorted point.
        cell_start (C + 1,): index of the first point of each cell.
        cell_z (C,): level of each cell.
        column_start (M + 1,): index of the first cell of each column.
        neighbours (M, H): the column itself and half of the columns up to `reach` away, -1 for
            empty ones. The other half list this column as their neighbour.
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
    columns = np.int64(0)  # for a plain 0, Numba compiles counting_sort a second time
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
    order = counting_sort(column, columns, _sort_by_height(z))[0]

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
    return order, cell_start[: cells + 1], cell_z[:cells], column_start, neighbours


@njit(cache=True, nogil=True)
def _sort_by_height(z):
    low, high = z.min(), z.max()
    order = np.arange(len(z))
    if high - low <= 8 * len(z) + 4096:
        return counting_sort((z - low).astype(np.int32), high - low + 1, order)[0]
    digit = np.empty(len(z), np.int32)
    for shift in range(0, 64, 16):  # far outliers make too many levels to count them at once
        for i in range(len(z)):
            digit[i] = ((z[i] - low) >> shift) & 0xFFFF
        order = counting_sort(digit, np.int64(0x10000), order)[0]
    return order


@njit(cache=True, nogil=True)
def take_columns(xyz, order):
    """Return the coordinates (3, N) float64 of points (N, 3), sorted by `order` (N,)."""
    out = np.empty((3, len(order)))
    for k in range(len(order)):
        i = order[k]
        out[0, k], out[1, k], out[2, k] = xyz[i, 0], xyz[i, 1], xyz[i, 2]
    return out


@njit(cache=True, nogil=True)
def is_near(x, y, z, i, j, eps2):
    """Return True if points i and j are within eps, in float64 as scikit-learn computes it."""
    dx, dy, dz = x[i] - x[j], y[i] - y[j], z[i] - z[j]
    return dx * dx + dy * dy + dz * dz <= eps2


@njit(cache=True, nogil=True)
def find_root(parent, i):
    """Return the root of i in a union-find forest, with path halving."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True, nogil=True)
def enlarge_array(values, count, capacity):
    """Copy values[:count] into a new array of this capacity."""
    enlarged = np.empty(capacity, values.dtype)
    for i in range(count):  # Numba takes seconds to compile an assignment of slices
        enlarged[i] = values[i]
    return enlarged


@njit(cache=True, nogil=True)
def number_clusters(order, core, owner, parent):
    """Number the sets of a union-find forest 1..K by their first core point in input order.

    Args:
        order: (N,) input row of each point, in grid order.
        core: (N,) bool, True for core points, in grid order.
        owner: (N,) set of each point, in grid order.
        parent: (S,) forest of the sets.

    Returns:
        (S,) int32 cluster of each set; 0 for sets without a core point.
    """
    grid_index = np.empty(len(order), np.int32)
    for k in range(len(order)):
        grid_index[order[k]] = k
    cluster = np.zeros(len(parent), np.int32)
    count = 0
    for i in range(len(order)):
        k = grid_index[i]
        if core[k]:
            root = find_root(parent, owner[k])
            if cluster[root] == 0:
                count += 1
                cluster[root] = count
    for s in range(len(parent)):
        cluster[s] = cluster[find_root(parent, s)]
    return cluster
