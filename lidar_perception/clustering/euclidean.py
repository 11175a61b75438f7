"""Adaptive Euclidean clustering (paper C: Zhang et al., PLOS One 2026, e0348581).

It implements Eq. 6 to 9 and 11. Eq. 10 is the objective that the method is said to minimise; no
step of the method uses it. The text of the paper lacks the equations, so they are reconstructed from
its description:

- Threshold d_i of point i. global: alpha times the mean distance of all N points to their nearest
  neighbour (Eq. 6). local: alpha times the mean distance to the other points within `radius`
  (Eq. 11), 0 if there are none. fixed: `distance`, as in plain Euclidean clustering. The first two
  are rounded to float32, so that the order of summation does not matter.
- A point is a core point if at least beta ln N points (MinPts, Eq. 7), itself included, lie within
  its d_i.
- Two core points are linked if their distance is within either threshold (Eq. 8). Clusters are the
  connected sets. Any other point joins the nearest core point whose threshold reaches it (if several
  are equally near, the one with the least x, then y, then z); otherwise it is in no cluster.
- With `curvature`, core points on uneven surfaces are treated as other points, see curvature.py.
- Clusters of fewer than min_size points are dropped. Then clusters are merged if their centres
  (means) are closer than gamma (D_i + D_j) / 2, where D is the diagonal of the axis-aligned box
  (Eq. 9). All pairs are compared before merging, and merging is transitive.

The clusters do not depend on the order of the points. No pairs are stored, so memory is linear in
the number of points. If the grid needs more than MAX_DISTANCES_PER_POINT, because many points share
a neighbourhood but are out of reach of each other, a k-d tree finds the same clusters.

Only the local threshold needs every pair. It is exact up to MAX_WORK_PER_POINT distances per point
(KITTI scans need less than 1,700, a Pandar64 scan close to surfaces needs 21,000) and MAX_WORK per
cloud, twice what the densest known scan needs. For denser clouds it uses a sample of each cell that
does not depend on the order of the points.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.clustering.cells import (
    Cells,
    compute_mean_neighbourhood_size,
    find_core_points,
    gather_neighbourhood,
    gather_sample,
    sample_cells,
    sort_into_cells,
)
from lidar_perception.clustering.curvature import find_consistent_points
from lidar_perception.clustering.grid import number_clusters
from lidar_perception.clustering.params import EuclideanParams
from lidar_perception.clustering.thinning import (
    MAX_DISTANCES_PER_POINT,
    SLACK,
    compute_max_exact_distances,
    thin_points,
)
from lidar_perception.clustering.tree import (
    Tree,
    build_tree,
    compute_squared_distance,
    find_components,
    find_core_points_in_tree,
    find_nearest_core_points,
    find_nearest_distances,
)

# The first cells are FIRST_CELL_MEDIANS times as wide as the median distance of SAMPLE_SIZE points
# to their nearest neighbours.
SAMPLE_SIZE, FIRST_CELL_MEDIANS = 64, 5
MAX_BRUTE_FORCE = 20_000_000  # number of distances above which points are sorted into larger cells
MAX_WORK = 2**32  # maximum number of distances per cloud for local thresholds
MAX_WORK_PER_POINT = 2**15  # maximum number of distances per point for local thresholds


def cluster_euclidean(
    xyz: np.ndarray,
    params: EuclideanParams = EuclideanParams(),
    max_distances: int = MAX_DISTANCES_PER_POINT,
    max_work: int = MAX_WORK,
    radii: np.ndarray | None = None,
) -> np.ndarray:
    """Cluster finite points by the adaptive Euclidean method.

    Args:
        xyz: (N, 3) float32 in metres; N may be 0. Distances are computed in float64.
        max_distances: maximum number of distances per point on the grid; beyond it, the tree is used.
        max_work: maximum number of distances for the local threshold; beyond it, a sample is used.
        radii: (N,) radius of each point for the local threshold, instead of params.radius.

    Returns:
        (N,) int32 ids, 0 for no cluster, 1..K for the clusters, numbered by their first point.
    """
    n = len(xyz)
    if n == 0:
        return np.zeros(0, np.int32)
    xyz = np.ascontiguousarray(xyz, np.float32)
    radii, max_work = (np.full(n, params.radius) if radii is None else radii, min(max_work, MAX_WORK_PER_POINT * n))
    if params.threshold == "global":
        mean, cells = _compute_mean_nearest_distance(xyz, max_distances)
        reach = np.full(n, np.float32(params.alpha * mean), np.float64)
    elif params.threshold == "fixed":
        cells, reach = sort_into_cells(xyz, params.distance), np.full(n, params.distance)
    else:
        cells, reach = sort_into_cells(xyz, float(radii.max())), np.empty(n)
        radii2, is_exact = radii[cells.order] ** 2, compute_mean_neighbourhood_size(cells) * n <= max_work
        means = (
            _compute_mean_distances(cells, radii2)
            if is_exact
            else _estimate_mean_distances(cells, sample_cells(cells, max_work), radii2)
        )
        reach[cells.order] = np.float32(params.alpha * means)
    if reach.max() > cells.reach:
        cells = sort_into_cells(xyz, reach.max())
    component, min_points = np.empty(n, np.int32), params.beta * np.log(n)
    can_grow = find_consistent_points(xyz, radii, params.curvature, max_work) if params.curvature else np.ones(n, bool)
    reach2 = reach[cells.order] ** 2
    is_core, budget = find_core_points(cells, reach2, min_points, float(max_distances * n))
    component[cells.order], budget = _find_components(
        cells, np.stack([*cells.xyz, reach2], axis=1), is_core & can_grow[cells.order], budget
    )
    if budget < 0:
        tree = build_tree(xyz)
        component[tree.order] = _find_components_by_tree(tree, reach[tree.order] ** 2, min_points, can_grow[tree.order])
    size = np.bincount(component + 1)  # size[0] counts the points without a component
    is_kept = (component >= 0) & (size[component + 1] >= params.min_size)
    parent, indices = np.arange(len(size), dtype=np.int32), np.arange(n)
    labels = np.where(is_kept, number_clusters(indices, is_kept, component, parent)[component], 0)
    if params.gamma > 0.0:
        parent = _merge_clusters(xyz, labels, params.gamma)
        labels = number_clusters(indices, is_kept, labels, parent)[labels]
    return labels.astype(np.int32)


def _compute_mean_nearest_distance(xyz: np.ndarray, max_distances: float) -> tuple[float, Cells]:
    """Compute the mean distance to the nearest other point.

    Points without a neighbour within reach of the cells are searched again in larger cells.

    Returns:
        The mean distance in metres, 0 for a single point; the first cells used.
    """
    n, coordinates = len(xyz), xyz.T.astype(np.float64, order="C")
    if n == 1:
        return 0.0, sort_into_cells(xyz, 0.0)
    sample = [_find_nearest_squared_distance(coordinates, n, i) for i in range(0, n, -(-n // SAMPLE_SIZE))]
    median = float(np.sqrt(np.median(sample)))
    first_cells = cells = sort_into_cells(xyz, max(FIRST_CELL_MEDIANS * median, 1e-3))
    squared = np.full(n, np.inf)
    while True:
        if _find_nearest_in_cells(cells, squared, max_distances * n) < 0:
            tree = build_tree(xyz)
            squared[tree.order] = find_nearest_distances(tree)[0]
            return np.sqrt(squared).mean(), first_cells
        unresolved = np.flatnonzero(squared > cells.reach**2)
        squared[unresolved] = np.inf  # a closer point may lie outside the searched cells
        if len(unresolved) * n <= MAX_BRUTE_FORCE:
            squared[unresolved] = [_find_nearest_squared_distance(coordinates, n, i) for i in unresolved]
            return np.sqrt(squared).mean(), first_cells
        cells = sort_into_cells(xyz, 4.0 * cells.reach)


@njit(cache=True, nogil=True)
def _find_nearest_squared_distance(points, size, i):
    """Return the squared distance from point i to the nearest other one of points (3, >= size).

    Non-negative floats sort like their bits, and the minimum of integers is vectorised.
    """
    px, py, pz = points[0, i], points[1, i], points[2, i]
    points[0, i] = np.inf  # excludes the point itself
    least_bits = np.int64(0x7FF0000000000000)  # inf
    for begin in range(0, size, 4096):
        for j in range(np.uint64(begin), np.uint64(min(begin + 4096, size))):
            dx, dy, dz = px - points[0, j], py - points[1, j], pz - points[2, j]
            squared = dx * dx + dy * dy + dz * dz
            least_bits = min(least_bits, np.float64(squared).view(np.int64))
        if least_bits == 0:
            break  # bounds the time for many coincident points
    points[0, i] = px
    return np.int64(least_bits).view(np.float64)


@njit(cache=True, nogil=True)
def _find_nearest_in_cells(cells, squared, budget):
    neighbours = np.empty((3, cells.size.max()))
    for a in range(len(cells.size)):
        needs_gathering = True
        for i in range(cells.start[a], cells.start[a + 1]):
            if squared[cells.order[i]] == np.inf:
                budget -= cells.size[a]
                if budget < 0:
                    return budget
                if needs_gathering:
                    gather_neighbourhood(cells, a, neighbours)
                    needs_gathering = False
                own_index = i - cells.start[cells.low[a, 0]]
                squared[cells.order[i]] = _find_nearest_squared_distance(neighbours, cells.size[a], own_index)
    return budget


@njit(cache=True, nogil=True, fastmath={"reassoc", "nsz"})
def _compute_mean_distances(cells, radii2):
    """Compute the mean distance (N,) to the other points within each point's radius, in cell order.

    Each distance is computed twice, which is faster than storing it.
    """
    means, neighbours = np.zeros(len(cells.order)), np.empty((3, cells.size.max()))
    x, y, z = cells.xyz[0], cells.xyz[1], cells.xyz[2]
    for a in range(len(cells.size)):
        gather_neighbourhood(cells, a, neighbours)
        for i in range(cells.start[a], cells.start[a + 1]):
            if i > cells.start[a] and x[i] == x[i - 1] and y[i] == y[i - 1] and z[i] == z[i - 1]:
                means[i] = means[i - 1]  # bounds the time for many coincident points
                continue
            px, py, pz, total, count = x[i], y[i], z[i], 0.0, 0.0
            radius2 = radii2[i]
            for j in range(np.uint64(cells.size[a])):
                dx, dy, dz = px - neighbours[0, j], py - neighbours[1, j], pz - neighbours[2, j]
                squared = dx * dx + dy * dy + dz * dz
                inside = squared <= radius2
                # Without these two variables the loop is not vectorised.
                distance = np.sqrt(squared) if inside else 0.0
                increment = 1.0 if inside else 0.0
                total += distance
                count += increment
            means[i] = total / max(count - 1.0, 1.0)  # count includes the point itself
    return means


@njit(cache=True, nogil=True, fastmath={"reassoc", "nsz"})
def _estimate_mean_distances(cells, sample, radii2):
    """Estimate the result of _compute_mean_distances from a sample of each cell."""
    means = np.zeros(len(cells.order))
    for a in range(len(cells.size)):
        neighbours, weight = gather_sample(cells, sample, a)
        for i in range(cells.start[a], cells.start[a + 1]):
            px, py, pz, radius2 = cells.xyz[0, i], cells.xyz[1, i], cells.xyz[2, i], radii2[i]
            total, count = 0.0, 0.0
            for j in range(len(weight)):
                dx, dy, dz = px - neighbours[0, j], py - neighbours[1, j], pz - neighbours[2, j]
                squared = dx * dx + dy * dy + dz * dz
                inside = squared <= radius2
                total += weight[j] * np.sqrt(squared) if inside else 0.0
                count += weight[j] if inside else 0.0
            means[i] = total / max(count - 1.0, 1.0)
    return means


def _find_components_by_tree(tree: Tree, reach2: np.ndarray, min_points: float, can_grow: np.ndarray) -> np.ndarray:
    """Return the result of _find_components in the order of the tree."""
    is_core = find_core_points_in_tree(tree, reach2, min_points)[0] & can_grow
    max_work = compute_max_exact_distances(len(is_core))
    component, work = find_components(tree, reach2, is_core, 0.0, max_work)
    if work > max_work:
        kept_rows, group = thin_points(tree.points[is_core], np.sqrt(reach2[is_core]))
        max_reach2 = np.zeros(len(kept_rows))
        np.maximum.at(max_reach2, group, reach2[is_core])
        thinned_tree = build_tree(tree.points[is_core][kept_rows])
        thinned_component = np.empty(len(kept_rows), np.int64)
        thinned_component[thinned_tree.order] = find_components(
            thinned_tree, max_reach2[thinned_tree.order] * (1 + SLACK) ** 2, np.ones(len(kept_rows), bool), 0.0, np.inf
        )[0]
        component[is_core] = thinned_component[group]
    core = find_nearest_core_points(tree, reach2, is_core)[0]
    return np.where(core >= 0, component[core], component)


@njit(cache=True, nogil=True)
def _find_components(cells, points, is_core, budget):
    """Find the connected sets of the points on the grid.

    items holds the points of each cell in three parts: core points that are not visited yet (up to
    new_end[a]), visited core points, and other points (from other_begin[a] on).

    Args:
        points: (N, 4) x, y, z and squared threshold of each point, in cell order.
        is_core: (N,) bool.
        budget: maximum number of distances.

    Returns:
        component (N,), the set of each point, -1 for none; the remaining budget, negative if the
        search stopped early.
    """
    n, start, new_end = len(points), cells.start, cells.start[1:].copy()
    cell, items, stack = np.empty(n, np.int32), np.arange(n), np.empty(n, np.int64)
    for a in range(len(new_end)):
        cell[start[a] : start[a + 1]] = a
        for i in range(start[a + 1] - 1, start[a] - 1, -1):
            if not is_core[i]:
                new_end[a] -= 1
                items[i], items[new_end[a]] = items[new_end[a]], i
    other_begin, count = new_end.copy(), 0
    component, nearest, least_squared = np.full(n, -1), np.full(n, -1), np.full(n, np.inf)
    for seed in range(len(new_end)):
        while new_end[seed] > start[seed]:
            new_end[seed] -= 1
            stack[0], stack_size = items[new_end[seed]], 1
            component[stack[0]] = count
            while stack_size:
                if budget < 0:
                    return component, budget
                stack_size -= 1
                i = stack[stack_size]
                p, a = points[i], cell[i]
                for k in range(cells.ranges[a]):
                    for b in range(cells.low[a, k], cells.high[a, k]):
                        budget -= new_end[b] - start[b] + start[b + 1] - other_begin[b]
                        for m in range(new_end[b] - 1, start[b] - 1, -1):
                            j = items[m]
                            if compute_squared_distance(p, points[j]) <= max(p[3], points[j, 3]):
                                component[j], stack[stack_size] = count, j
                                new_end[b] -= 1
                                stack_size += 1
                                items[m], items[new_end[b]] = items[new_end[b]], j
                        for m in range(other_begin[b], start[b + 1]):
                            j = items[m]
                            squared, q = compute_squared_distance(p, points[j]), points[nearest[j]]
                            if squared <= p[3] and (
                                squared < least_squared[j]
                                or (squared == least_squared[j] and (p[0], p[1], p[2]) < (q[0], q[1], q[2]))
                            ):
                                least_squared[j], nearest[j] = squared, i
            count += 1
    for i in range(n):
        if nearest[i] >= 0:
            component[i] = component[nearest[i]]
    return component, budget


def _merge_clusters(xyz: np.ndarray, labels: np.ndarray, gamma: float) -> np.ndarray:
    """Return the union-find forest of the labels after merging by Eq. 9."""
    centre, diameter = _compute_centres(xyz, labels)
    parent = np.arange(len(centre), dtype=np.int32)
    if len(centre) > 2:
        tree = build_tree(centre[1:])
        selected = np.ones(len(tree.order), bool)
        tree_component = find_components(tree, diameter[1:][tree.order], selected, gamma, np.inf)[0]
        component = np.empty(len(tree_component), np.int64)
        component[tree.order] = tree_component
        parent[1:] = np.unique(component, return_index=True)[1][component] + 1
    return parent


@njit(cache=True, nogil=True)
def _compute_centres(xyz, labels):
    """Return means (K + 1, 3) and box diagonals (K + 1,) by label; row 0 belongs to no cluster."""
    count = labels.max() + 1
    size, centre, diameter = np.zeros(count), np.zeros((count, 3)), np.zeros(count)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for i in range(len(labels)):
        size[labels[i]] += 1
        for axis in range(3):
            entry, value = (labels[i], axis), np.float64(xyz[i, axis])
            centre[entry] += value
            low[entry], high[entry] = min(low[entry], value), max(high[entry], value)
    for a in range(1, count):
        centre[a] /= size[a]
        diameter[a] = np.sqrt(compute_squared_distance(low[a], high[a]))
    return centre, diameter
