"""Adaptive Euclidean clustering (paper C: Zhang et al., PLOS One 2026, e0348581, Eq. 6 to 11).

The equations are missing from the text of the paper; this is our reading of what it says of them.

- Threshold d_i of point i. global: alpha times the mean distance of all N points to their nearest
  other point (Eq. 6). local: alpha times the mean distance to the other points within `radius`
  (Eq. 11). 0 where there is none. Rounded to float32, so that no order of summation matters.
  fixed: `distance`, as in plain Euclidean clustering.
- A point leads if beta ln N points (MinPts, Eq. 7) or more, itself included, lie within its d_i.
- Two leaders within the threshold of one of them are linked (Eq. 8); clusters are the connected
  sets. Any other point follows the nearest leader whose threshold reaches it (of leaders equally
  near: the least x, then y, then z), and is in no cluster where there is none.
- Clusters below min_size points are dropped. Then clusters are merged whose centres (means) are
  nearer than gamma (D_i + D_j) / 2, D the diagonal of the axis-aligned box (Eq. 9): all pairs are
  tested as they are before merging, and chains merge.

So the clusters do not depend on the order of the points. No pairs are stored: memory grows with
the number of points only. Where the grid takes more than PATIENCE distances a point, because it
is crowded with points out of reach of each other, a tree finds the same. Only the local threshold
has to look at every pair: it is exact up to WORK_A_POINT distances a point, where scans of KITTI
take less than 1,700 and one of a Pandar64 among near surfaces 21,000, and WORK a cloud, twice what
the densest scan known takes; of denser clouds it takes a sample of each cell, the same of the same
points.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.clustering.cells import (
    Cells,
    around,
    cells_of,
    crowded,
    gather,
    gather_sample,
    sample_of,
)
from lidar_perception.clustering.grid import number_clusters
from lidar_perception.clustering.params import EuclideanParams
from lidar_perception.clustering.thinned import PATIENCE, SLACK, thinned
from lidar_perception.clustering.thinned import patience as budget
from lidar_perception.clustering.tree import Tree, connected, nearest, nearest_leaders, tree_of
from lidar_perception.clustering.tree import crowded as count_crowded

SAMPLE, SIDES = 64, 5  # the first cells are 5 medians of a sample's nearest distances wide
BUDGET = 20_000_000    # distances that are rather computed than to sort points into larger cells
WORK = 2**32           # distances for local thresholds
WORK_A_POINT = 2**15   # of them a point


def euclidean(xyz: np.ndarray, params: EuclideanParams = EuclideanParams(),
              patience: int = PATIENCE, work: int = WORK,
              radii: np.ndarray | None = None) -> np.ndarray:
    """(N,) int32 clusters of finite points (N, 3) float32, metres: 0 none, 1..K by their first
    point; N may be 0. Distances are computed in float64. patience and work: see PATIENCE, WORK.
    radii (N,): for the local threshold, of each point instead of params.radius."""
    n = len(xyz)
    if n == 0:
        return np.zeros(0, np.int32)
    xyz = np.ascontiguousarray(xyz, np.float32)
    if params.threshold == "global":
        mean, cells = _mean_nearest(xyz, patience)
        reach = np.full(n, np.float32(params.alpha * mean), np.float64)
    elif params.threshold == "fixed":
        cells, reach = cells_of(xyz, params.distance), np.full(n, params.distance)
    else:
        radii = np.full(n, params.radius) if radii is None else radii
        cells, reach = cells_of(xyz, float(radii.max())), np.empty(n)
        radii2, work = radii[cells.order] ** 2, min(work, WORK_A_POINT * n)
        means = (_means(cells, radii2) if around(cells) * n <= work else
                 _means_of_sample(cells, sample_of(cells, work), radii2))
        reach[cells.order] = np.float32(params.alpha * means)
    if reach.max() > cells.reach:
        cells = cells_of(xyz, reach.max())
    component, enough = np.empty(n, np.int32), params.beta * np.log(n)
    reach2 = reach[cells.order] ** 2
    leads, left = crowded(cells, reach2, enough, float(patience * n))
    component[cells.order], left = _components(cells, np.stack([*cells.xyz, reach2], axis=1), leads,
                                               left)
    if left < 0:
        tree = tree_of(xyz)
        component[tree.order] = _components_by_tree(tree, reach[tree.order] ** 2, enough)
    size = np.bincount(component + 1)  # the first is of none
    kept = (component >= 0) & (size[component + 1] >= params.min_size)
    parent, indices = np.arange(len(size), dtype=np.int32), np.arange(n)
    labels = np.where(kept, number_clusters(indices, kept, component, parent)[component], 0)
    if params.gamma > 0.0:
        parent = _merged(xyz, labels, params.gamma)
        labels = number_clusters(indices, kept, labels, parent)[labels]
    return labels.astype(np.int32)


def _mean_nearest(xyz: np.ndarray, patience: float) -> tuple[float, Cells]:
    """Mean distance to the nearest other point, 0 for one point; and cells. Points with none
    within reach of the cells wait for larger ones."""
    n, columns = len(xyz), xyz.T.astype(np.float64, order="C")
    if n == 1:
        return 0.0, cells_of(xyz, 0.0)
    sample = [_nearest(columns, n, i) for i in range(0, n, -(-n // SAMPLE))]
    first = cells = cells_of(xyz, max(SIDES * float(np.sqrt(np.median(sample))), 1e-3))
    squared = np.full(n, np.inf)
    while True:
        if _search(cells, squared, patience * n) < 0:
            tree = tree_of(xyz)
            squared[tree.order] = nearest(tree)[0]
            return np.sqrt(squared).mean(), first
        waiting = np.flatnonzero(squared > cells.reach ** 2)
        squared[waiting] = np.inf  # what was found may not be the nearest
        if len(waiting) * n <= BUDGET:
            squared[waiting] = [_nearest(columns, n, i) for i in waiting]
            return np.sqrt(squared).mean(), first
        cells = cells_of(xyz, 4.0 * cells.reach)


@njit(cache=True, nogil=True)
def _nearest(points, size, i):
    """Squared distance of point i to the nearest other one of points (3, >= size). Floats from 0
    on compare as their bits do, and a minimum of integers makes a vector loop."""
    px, py, pz = points[0, i], points[1, i], points[2, i]
    points[0, i] = np.inf  # not itself
    least = np.int64(0x7FF0000000000000)  # inf
    for begin in range(0, size, 4096):
        for j in range(np.uint64(begin), np.uint64(min(begin + 4096, size))):
            dx, dy, dz = px - points[0, j], py - points[1, j], pz - points[2, j]
            squared = dx * dx + dy * dy + dz * dz
            least = min(least, np.float64(squared).view(np.int64))
        if least == 0:
            break  # however many coincide
    points[0, i] = px
    return np.int64(least).view(np.float64)


@njit(cache=True, nogil=True)
def _search(cells, squared, work):
    near = np.empty((3, cells.size.max()))
    for a in range(len(cells.size)):
        empty = True
        for i in range(cells.start[a], cells.start[a + 1]):
            if squared[cells.order[i]] == np.inf:
                work -= cells.size[a]
                if work < 0:
                    return work
                if empty:
                    gather(cells, a, near)
                    empty = False
                own = i - cells.start[cells.low[a, 0]]
                squared[cells.order[i]] = _nearest(near, cells.size[a], own)
    return work


@njit(cache=True, nogil=True, fastmath={"reassoc", "nsz"})
def _means(cells, radii2):
    """(N,) mean distance to the other points within the radius of each, cell by cell. Each pair is
    computed twice: without stores that is faster than once."""
    means, near = np.zeros(len(cells.order)), np.empty((3, cells.size.max()))
    x, y, z = cells.xyz[0], cells.xyz[1], cells.xyz[2]
    for a in range(len(cells.size)):
        gather(cells, a, near)
        for i in range(cells.start[a], cells.start[a + 1]):
            if i > cells.start[a] and x[i] == x[i - 1] and y[i] == y[i - 1] and z[i] == z[i - 1]:
                means[i] = means[i - 1]  # however many coincide
                continue
            px, py, pz, total, count = x[i], y[i], z[i], 0.0, 0.0
            radius2 = radii2[i]
            for j in range(np.uint64(cells.size[a])):
                dx, dy, dz = px - near[0, j], py - near[1, j], pz - near[2, j]
                squared = dx * dx + dy * dy + dz * dz
                inside = squared <= radius2
                distance = np.sqrt(squared) if inside else 0.0  # named, or it is no vector loop
                one = 1.0 if inside else 0.0
                total += distance
                count += one
            means[i] = total / max(count - 1.0, 1.0)  # itself is one of them
    return means


@njit(cache=True, nogil=True, fastmath={"reassoc", "nsz"})
def _means_of_sample(cells, sample, radii2):
    """As _means, from a sample of each cell whose points stand for all of it."""
    means = np.zeros(len(cells.order))
    for a in range(len(cells.size)):
        near, weight = gather_sample(cells, sample, a)
        for i in range(cells.start[a], cells.start[a + 1]):
            px, py, pz, radius2 = cells.xyz[0, i], cells.xyz[1, i], cells.xyz[2, i], radii2[i]
            total, count = 0.0, 0.0
            for j in range(len(weight)):
                dx, dy, dz = px - near[0, j], py - near[1, j], pz - near[2, j]
                squared = dx * dx + dy * dy + dz * dz
                inside = squared <= radius2
                total += weight[j] * np.sqrt(squared) if inside else 0.0
                count += weight[j] if inside else 0.0
            means[i] = total / max(count - 1.0, 1.0)
    return means


def _components_by_tree(tree: Tree, reach2: np.ndarray, enough: float) -> np.ndarray:
    """As _components, in the order of the tree."""
    leads = count_crowded(tree, reach2, enough)[0]
    component, work = connected(tree, reach2, leads, 0.0, budget(len(leads)))
    if work > budget(len(leads)):
        kept, group = thinned(tree.points[leads], np.sqrt(reach2[leads]))
        widest = np.zeros(len(kept))
        np.maximum.at(widest, group, reach2[leads])
        thin = tree_of(tree.points[leads][kept])
        found = np.empty(len(kept), np.int64)
        found[thin.order] = connected(thin, widest[thin.order] * (1 + SLACK) ** 2,
                                      np.ones(len(kept), bool), 0.0, np.inf)[0]
        component[leads] = found[group]
    leader = nearest_leaders(tree, reach2, leads)[0]
    return np.where(leader >= 0, component[leader], component)


@njit(cache=True, nogil=True)
def _squared(p, q):
    dx, dy, dz = p[0] - q[0], p[1] - q[1], p[2] - q[2]
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True)
def _components(cells, points, leads, work):
    """(N,) connected set of each of points (N, 4), x y z and the square of the threshold; -1 for
    none; and how much is left of the work, as crowded does. items are the points of each cell:
    leaders not yet found, found ones, followers."""
    n, start, left = len(points), cells.start, cells.start[1:].copy()
    cell, items, stack = np.empty(n, np.int32), np.arange(n), np.empty(n, np.int64)
    for a in range(len(left)):
        cell[start[a]:start[a + 1]] = a
        for i in range(start[a + 1] - 1, start[a] - 1, -1):
            if not leads[i]:
                left[a] -= 1
                items[i], items[left[a]] = items[left[a]], i
    followers, count = left.copy(), 0
    component, leader, least = np.full(n, -1), np.full(n, -1), np.full(n, np.inf)
    for seed in range(len(left)):
        while left[seed] > start[seed]:
            left[seed] -= 1
            stack[0], waiting = items[left[seed]], 1
            component[stack[0]] = count
            while waiting:
                if work < 0:
                    return component, work
                waiting -= 1
                i = stack[waiting]
                p, a = points[i], cell[i]
                for k in range(cells.ranges[a]):
                    for b in range(cells.low[a, k], cells.high[a, k]):
                        work -= left[b] - start[b] + start[b + 1] - followers[b]
                        for m in range(left[b] - 1, start[b] - 1, -1):
                            j = items[m]
                            if _squared(p, points[j]) <= max(p[3], points[j, 3]):
                                component[j], stack[waiting] = count, j
                                left[b] -= 1
                                waiting += 1
                                items[m], items[left[b]] = items[left[b]], j
                        for m in range(followers[b], start[b + 1]):
                            j = items[m]
                            squared, q = _squared(p, points[j]), points[leader[j]]
                            if squared <= p[3] and (squared < least[j] or (
                                    squared == least[j]
                                    and (p[0], p[1], p[2]) < (q[0], q[1], q[2]))):
                                least[j], leader[j] = squared, i
            count += 1
    for i in range(n):
        if leader[i] >= 0:
            component[i] = component[leader[i]]
    return component, work


def _merged(xyz: np.ndarray, labels: np.ndarray, gamma: float) -> np.ndarray:
    """Union-find forest of the labels after Eq. 9."""
    centre, diameter = _centres(xyz, labels)
    parent = np.arange(len(centre), dtype=np.int32)
    if len(centre) > 2:
        tree = tree_of(centre[1:])
        every = np.ones(len(tree.order), bool)
        joined = connected(tree, diameter[1:][tree.order], every, gamma, np.inf)[0]
        component = np.empty(len(joined), np.int64)
        component[tree.order] = joined
        parent[1:] = np.unique(component, return_index=True)[1][component] + 1
    return parent


@njit(cache=True, nogil=True)
def _centres(xyz, labels):
    """(K + 1, 3) means and (K + 1,) diagonals of the boxes of clusters 1..K, and of no cluster."""
    count = labels.max() + 1
    size, centre, diameter = np.zeros(count), np.zeros((count, 3)), np.zeros(count)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for i in range(len(labels)):
        size[labels[i]] += 1
        for axis in range(3):
            c, v = (labels[i], axis), np.float64(xyz[i, axis])
            centre[c] += v
            low[c], high[c] = min(low[c], v), max(high[c], v)
    for a in range(1, count):
        centre[a] /= size[a]
        diameter[a] = np.sqrt(_squared(low[a], high[a]))
    return centre, diameter
