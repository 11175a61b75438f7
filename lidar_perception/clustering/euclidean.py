"""Adaptive Euclidean clustering (paper C: Zhang et al., PLOS One 2026, e0348581, Eq. 6 to 11).

The equations are missing from the text of the paper; this is our reading of their descriptions.

- Threshold d_i of point i. global: alpha times the mean, over all points, of the distance to the
  nearest other point (Eq. 6). local: alpha times the mean distance to the other points within
  `radius` (Eq. 11). 0 without such points. Rounded to float32, so that the order of the
  summation does not matter. Coincident points are neighbours at distance 0.
- A point leads when at least MinPts = beta ln N (Eq. 7) of the N points, itself included, lie
  within d_i of it (Eq. 8).
- Two leaders are linked when their distance is within the threshold of one of them. The connected
  sets of leaders are the clusters. A point that does not lead follows the nearest leader whose
  threshold reaches it (of leaders equally near: the least x, then y, then z), and is in no cluster
  where there is none.
- Clusters below min_size points are dropped; then clusters are merged whose centres (means) are
  nearer than gamma (D_i + D_j) / 2, D the diagonal of the axis-aligned box (Eq. 9). Each pair is
  tested once, as it was before merging; chains merge.

The partition does not depend on the order of the points. No pairs of points are stored: memory
grows with the number of points only, time (local) with the number of neighbours within radius.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from lidar_perception.clustering.grid import grid, near, root
from lidar_perception.params import EuclideanParams

SMALLEST = 1e-6   # metres, side of a cell at least: the thresholds can be 0
SAMPLE = 128      # points whose nearest neighbour is looked for among all
BUDGET = 2e7      # distances that are computed rather than to sort the points into larger cells
FACTOR = 6.0      # side of the first cells, in medians of the sample's distances
GROWTH = 4.0      # of the cells, from one search of the nearest neighbours to the next


def euclidean(xyz: np.ndarray, params: EuclideanParams = EuclideanParams()) -> np.ndarray:
    """(N,) int32 cluster ids of finite points (N, 3) float32, metres: 0 none, 1..K, numbered by
    the first point of each cluster. Distances are float64."""
    n = len(xyz)
    if n == 0:
        return np.zeros(0, np.int32)
    xyz = np.ascontiguousarray(xyz, np.float32)
    if params.threshold == "global":
        mean, cells = _mean_nearest(xyz)
        reach = np.full(n, np.float32(params.alpha * mean), np.float64)
    else:
        cells = _cells(xyz, params.radius)
        mean = _mean_near(cells, params.radius ** 2)
        reach = (params.alpha * mean).astype(np.float32).astype(np.float64)
    farthest = reach.max()
    if farthest > cells.reach:
        by_row = np.empty(n)
        by_row[cells.order] = reach
        cells = _cells(xyz, farthest)
        reach = by_row[cells.order]
    reach *= reach
    leads = _leads(cells, reach, int(np.ceil(params.beta * np.log(n))))
    labels = _numbered(_components(cells, reach, leads), params.min_size)
    return _merged(xyz, labels, params.gamma) if params.gamma > 0.0 else labels


class _Cells(NamedTuple):
    """Points sorted into cells: order (N,) their rows; start (C+1,) first point of each cell; low
    and high (C, 9) the cells around a cell, one range in each of 9 columns, first those of 5 that
    make each pair of cells once. All points within reach of a point lie in cells around its own."""

    reach: float
    order: np.ndarray
    start: np.ndarray
    low: np.ndarray
    high: np.ndarray
    x: np.ndarray
    y: np.ndarray
    z: np.ndarray


def _cells(xyz, reach):
    # A hair over, so that rounding never puts two neighbours more than a cell apart.
    side = max(reach, SMALLEST) * (1.0 + 1e-6)
    order, start, cell_z, column_start, neighbours = grid(xyz, side, 1)
    low, high = _around(cell_z, column_start, neighbours)
    x, y, z = _sorted(xyz, order)
    return _Cells(reach, order, start, low, high, x, y, z)


@njit(cache=True, nogil=True)
def _around(cell_z, column_start, neighbours):
    columns, half = neighbours.shape
    every = np.full((columns, 2 * half - 1), -1, np.int64)
    every[:, :half] = neighbours
    for c in range(columns):
        for k in range(1, half):
            if neighbours[c, k] >= 0:
                every[neighbours[c, k], half - 1 + k] = c
    low = np.zeros((len(cell_z), 2 * half - 1), np.int32)
    high = np.zeros_like(low)
    for c in range(columns):
        for k in range(2 * half - 1):
            if every[c, k] < 0:
                continue
            begin = end = column_start[every[c, k]]
            last = column_start[every[c, k] + 1]
            for a in range(column_start[c], column_start[c + 1]):
                while begin < last and cell_z[begin] < cell_z[a] - 1:
                    begin += 1
                end = max(end, begin)
                while end < last and cell_z[end] <= cell_z[a] + 1:
                    end += 1
                low[a, k], high[a, k] = begin, end
    return low, high


@njit(cache=True, nogil=True)
def _sorted(xyz, order):
    out = np.empty((3, len(order)))
    for k in range(len(order)):
        for axis in range(3):
            out[axis, k] = xyz[order[k], axis]
    return out


@njit(cache=True, nogil=True)
def _gather(cells, a, out):
    """The points around cell a side by side, so that loops are long: (3, >= size) and size. They
    are put into out where it is large enough."""
    start, low, high = cells.start, cells.low, cells.high
    size = 0
    for k in range(low.shape[1]):
        size += start[high[a, k]] - start[low[a, k]]
    if size > out.shape[1]:
        out = np.empty((3, 2 * size))
    size = 0
    for k in range(low.shape[1]):
        for j in range(start[low[a, k]], start[high[a, k]]):
            out[0, size], out[1, size], out[2, size] = cells.x[j], cells.y[j], cells.z[j]
            size += 1
    return out, size


def _mean_nearest(xyz):
    """Mean distance to the nearest other point, 0 for one point, and the cells of the first
    search. A point whose nearest is beyond the reach of the cells waits for larger ones."""
    n = len(xyz)
    if n == 1:
        return 0.0, _cells(xyz, 0.0)
    squared = np.full(n, np.inf)
    x, y, z = np.ascontiguousarray(xyz.T, np.float64)
    _search_all(x, y, z, np.arange(0, n, max(1, n // SAMPLE)), squared)
    side = FACTOR * float(np.sqrt(np.median(squared[np.isfinite(squared)])))
    first = cells = _cells(xyz, max(side, 1e-3))
    while True:
        _search(cells, squared)
        waiting = np.flatnonzero(squared > cells.reach ** 2)
        if len(waiting) * n <= BUDGET:
            _search_all(x, y, z, waiting, squared)
            return np.sqrt(squared).mean(), first
        squared[waiting] = np.inf  # what was found may not be the nearest
        cells = _cells(xyz, GROWTH * cells.reach)


@njit(cache=True, nogil=True)
def _least(x, y, z, begin, end, px, py, pz):
    """Smallest squared distance, inf for no points. Floats from 0 on compare as their bits do, and
    of integers the compiler makes a loop that is 6 times as fast."""
    least = np.int64(0x7FF0000000000000)
    for j in range(np.uint64(begin), np.uint64(end)):
        dx, dy, dz = px - x[j], py - y[j], pz - z[j]
        squared = dx * dx + dy * dy + dz * dz
        least = min(least, np.float64(squared).view(np.int64))
    return np.int64(least).view(np.float64)


@njit(cache=True, nogil=True)
def _search_all(x, y, z, rows, squared):
    squared[rows] = np.inf
    for begin in range(0, len(x), 1024):  # a part that stays in the cache
        end = min(begin + 1024, len(x))
        for i in rows:
            split = min(max(begin, i), end)
            squared[i] = min(squared[i], _least(x, y, z, begin, split, x[i], y[i], z[i]),
                             _least(x, y, z, max(begin, i + 1), end, x[i], y[i], z[i]))


@njit(cache=True, nogil=True)
def _search(cells, squared):
    around = np.empty((3, 1024))
    for a in range(len(cells.start) - 1):
        size = 0
        for i in range(cells.start[a], cells.start[a + 1]):
            if squared[cells.order[i]] < np.inf:
                continue
            if size == 0:
                around, size = _gather(cells, a, around)
            x, y, z = around[0], around[1], around[2]
            px, py, pz = cells.x[i], cells.y[i], cells.z[i]
            mine = i - cells.start[cells.low[a, 0]]
            x[mine] = np.inf
            least = np.inf
            for begin in range(0, size, 1024):
                least = min(least, _least(x, y, z, begin, min(begin + 1024, size), px, py, pz))
                if least == 0.0:
                    break
            x[mine] = px
            squared[cells.order[i]] = least


@njit(cache=True, nogil=True, fastmath={"reassoc", "nsz"})
def _sum_near(x, y, z, size, px, py, pz, radius2):
    total, count = 0.0, 0.0
    for j in range(size):
        dx, dy, dz = px - x[j], py - y[j], pz - z[j]
        squared = dx * dx + dy * dy + dz * dz
        inside = squared <= radius2
        distance = np.sqrt(squared) if inside else 0.0  # without the names the loop is 5 times
        one = 1.0 if inside else 0.0                    # as slow
        total += distance
        count += one
    return total, count


@njit(cache=True, nogil=True)
def _mean_near(cells, radius2):
    """(N,) mean distance to the other points within the radius, 0 where there is none; in the
    order of the cells. Each pair is computed twice: without stores that is faster than once."""
    mean = np.zeros(len(cells.order))
    around = np.empty((3, 1024))
    for a in range(len(cells.start) - 1):
        around, size = _gather(cells, a, around)
        x, y, z = around[0], around[1], around[2]
        for i in range(cells.start[a], cells.start[a + 1]):
            px, py, pz = cells.x[i], cells.y[i], cells.z[i]
            if i > cells.start[a] and (px == cells.x[i - 1] and py == cells.y[i - 1]
                                       and pz == cells.z[i - 1]):
                mean[i] = mean[i - 1]
                continue
            total, count = _sum_near(x, y, z, size, px, py, pz, radius2)
            mean[i] = total / max(count - 1.0, 1.0)  # itself is among them
    return mean


@njit(cache=True, nogil=True)
def _count(x, y, z, begin, end, px, py, pz, reach2):
    count = 0
    for j in range(np.uint64(begin), np.uint64(end)):
        dx, dy, dz = px - x[j], py - y[j], pz - z[j]
        one = 1 if dx * dx + dy * dy + dz * dz <= reach2 else 0
        count += one
    return count


@njit(cache=True, nogil=True)
def _leads(cells, reach2, enough):
    """(N,) bool in the order of the cells: Eq. 8."""
    leads = np.zeros(len(cells.order), np.bool_)
    around = np.empty((3, 1024))
    for a in range(len(cells.start) - 1):
        size = 0
        for i in range(cells.start[a], cells.start[a + 1]):
            if size == 0:
                around, size = _gather(cells, a, around)
            x, y, z = around[0], around[1], around[2]
            found = 0
            for begin in range(0, size, 256):
                found += _count(x, y, z, begin, min(begin + 256, size), cells.x[i], cells.y[i],
                                cells.z[i], reach2[i])
                if found >= enough:
                    leads[i] = True
                    break
    return leads


def _components(cells, reach2, leads):
    """(N,) int32, by row: the connected set of leaders that each point belongs to, -1 for none."""
    chosen = np.flatnonzero(leads)
    first = np.concatenate([[0], np.cumsum(leads)])[cells.start]
    within, group_start, group_first = _groups(*(v[chosen] for v in (cells.x, cells.y, cells.z,
                                                                    reach2)), first)
    chosen = chosen[within]
    x, y, z, r = (v[chosen] for v in (cells.x, cells.y, cells.z, reach2))
    parent = _joined(x, y, z, r, group_start, group_first, cells.low, cells.high)
    return _spread(cells, leads, chosen, x, y, z, r, first, group_start, parent)


@njit(cache=True, nogil=True)
def _squared(ax, ay, az, bx, by, bz):
    dx, dy, dz = ax - bx, ay - by, az - bz
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True)
def _linked(x, y, z, r, i, j):
    return near(x, y, z, i, j, max(r[i], r[j]))


@njit(cache=True, nogil=True)
def _groups(x, y, z, r, first):
    """Leaders of a cell that are linked within the cell, side by side: order (L,), start (G+1,)
    of each group, and first (C+1,) group of each cell."""
    n = len(x)
    parent = np.arange(n).astype(np.int32)
    order, start = np.empty(n, np.int64), np.empty(n + 1, np.int64)
    group_first = np.empty(len(first), np.int64)
    groups, placed = 0, 0
    for a in range(len(first) - 1):
        group_first[a] = groups
        sets = 0
        for i in range(first[a], first[a + 1]):
            sets += 1
            j = i - 1
            while sets > 1 and j >= first[a]:
                one, other = root(parent, i), root(parent, j)
                if one != other and _linked(x, y, z, r, i, j):
                    parent[max(one, other)] = min(one, other)
                    sets -= 1
                j -= 1
        for i in range(first[a], first[a + 1]):
            if parent[i] == i:
                start[groups] = placed
                groups += 1
                for j in range(i, first[a + 1]):
                    if sets == 1 or root(parent, j) == i:
                        order[placed] = j
                        placed += 1
                if sets == 1:
                    break
    start[groups], group_first[len(first) - 1] = n, groups
    return order, start[:groups + 1], group_first


@njit(cache=True, nogil=True)
def _joined(x, y, z, r, start, first, low, high):
    """Union-find forest (G,) of the groups: two are joined at their first pair of linked points."""
    groups = len(start) - 1
    parent = np.arange(groups).astype(np.int32)
    extent = np.empty((groups, 7))
    for g in range(groups):
        s, e = start[g], start[g + 1]
        extent[g, 0], extent[g, 1], extent[g, 2] = x[s:e].min(), y[s:e].min(), z[s:e].min()
        extent[g, 3], extent[g, 4], extent[g, 5] = x[s:e].max(), y[s:e].max(), z[s:e].max()
        extent[g, 6] = r[s:e].max()
    for a in range(len(first) - 1):
        for g in range(first[a], first[a + 1]):
            for k in range((low.shape[1] + 1) // 2):
                begin = first[low[a, k]]
                for h in range(max(begin, g + 1) if k == 0 else begin, first[high[a, k]]):
                    one, other = root(parent, g), root(parent, h)
                    if one != other and _touch(x, y, z, r, start, extent, g, h):
                        parent[max(one, other)] = min(one, other)
    return parent


@njit(cache=True, nogil=True)
def _touch(x, y, z, r, start, extent, g, h):
    box, other = extent[g], extent[h]
    if _gap2(box[0], box[1], box[2], box[3], box[4], box[5], other) > max(box[6], other[6]):
        return False
    for i in range(start[g], start[g + 1]):
        if _gap2(x[i], y[i], z[i], x[i], y[i], z[i], other) <= max(r[i], other[6]):
            for j in range(start[h], start[h + 1]):
                if _linked(x, y, z, r, i, j):
                    return True
    return False


@njit(cache=True, nogil=True)
def _gap2(x0, y0, z0, x1, y1, z1, box):
    dx = max(box[0] - x1, 0.0, x0 - box[3])
    dy = max(box[1] - y1, 0.0, y0 - box[4])
    dz = max(box[2] - z1, 0.0, z0 - box[5])
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True)
def _spread(cells, leads, chosen, x, y, z, r, first, group_start, parent):
    """Leaders get the set of their group, followers that of their leader."""
    result = np.full(len(leads), -1, np.int32)
    mine = np.empty(len(x), np.int32)
    for g in range(len(parent)):
        mine[group_start[g]:group_start[g + 1]] = root(parent, g)
    for k in range(len(x)):
        result[cells.order[chosen[k]]] = mine[k]
    start, low, high = cells.start, cells.low, cells.high
    for a in range(len(start) - 1):
        for i in range(start[a], start[a + 1]):
            if leads[i]:
                continue
            px, py, pz = cells.x[i], cells.y[i], cells.z[i]
            best, least = -1, np.inf
            for k in range(low.shape[1]):
                for j in range(first[low[a, k]], first[high[a, k]]):
                    squared = _squared(px, py, pz, x[j], y[j], z[j])
                    if squared <= r[j] and (squared < least or (squared == least and (
                            (x[j], y[j], z[j]) < (x[best], y[best], z[best])))):
                        best, least = j, squared
            if best >= 0:
                result[cells.order[i]] = mine[best]
    return result


@njit(cache=True, nogil=True)
def _numbered(component, min_size):
    """(N,) int32 labels of components (below 0: none) 0..N-1 with at least min_size points, 1..K
    by their first point."""
    size = np.zeros(len(component), np.int64)
    for c in component:
        if c >= 0:
            size[c] += 1
    number = np.zeros(len(component), np.int32)
    labels = np.zeros(len(component), np.int32)
    last = 0
    for i in range(len(component)):
        c = component[i]
        if c >= 0 and size[c] >= min_size:
            if number[c] == 0:
                last += 1
                number[c] = last
            labels[i] = number[c]
    return labels


@njit(cache=True, nogil=True)
def _merged(xyz, labels, gamma):
    """Labels after Eq. 9. Spans of clusters along x that do not overlap need no test."""
    count = labels.max()
    size, centre = np.zeros(count + 1), np.zeros((count + 1, 3))
    low, high = np.full((count + 1, 3), np.inf), np.full((count + 1, 3), -np.inf)
    for i in range(len(labels)):
        c = labels[i]
        size[c] += 1
        for axis in range(3):
            v = np.float64(xyz[i, axis])
            centre[c, axis] += v
            low[c, axis], high[c, axis] = min(low[c, axis], v), max(high[c, axis], v)
    diameter = np.zeros(count + 1)
    for c in range(1, count + 1):
        centre[c] /= size[c]
        diameter[c] = np.sqrt(_squared(high[c, 0], high[c, 1], high[c, 2],
                                       low[c, 0], low[c, 1], low[c, 2]))
    span = gamma * diameter / 2.0 + SMALLEST
    order = 1 + np.argsort((centre[:, 0] - span)[1:])
    parent = np.arange(count + 1).astype(np.int32)
    for k in range(count):
        a = order[k]
        for m in range(k + 1, count):
            b = order[m]
            if centre[b, 0] - span[b] > centre[a, 0] + span[a]:
                break
            distance = np.sqrt(_squared(centre[a, 0], centre[a, 1], centre[a, 2],
                                        centre[b, 0], centre[b, 1], centre[b, 2]))
            if distance < gamma * (diameter[a] + diameter[b]) / 2.0:
                one, other = root(parent, a), root(parent, b)
                parent[max(one, other)] = min(one, other)
    component = np.empty(len(labels), np.int32)
    for i in range(len(labels)):
        component[i] = root(parent, labels[i]) - 1  # 0, none, is its own root
    return _numbered(component, 1)
