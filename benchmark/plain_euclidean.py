"""Plain implementation of paper C's adaptive Euclidean clustering with SciPy and NumPy.

It is compared with lidar_perception.clustering.euclidean, whose docstring has the definition and the
equations. It shares only the parameters with our code.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from lidar_perception.clustering.params import EuclideanParams

MAX_NEIGHBOURS = 4_000_000  # maximum number of neighbours held in memory: about 300 MB


def cluster_euclidean(xyz: np.ndarray, params: EuclideanParams = EuclideanParams()) -> np.ndarray:
    """Cluster points (N, 3) float32, metres. Return (N,) int32 ids: 0 for no cluster, 1 to K for clusters."""
    if len(xyz) == 0:
        return np.zeros(0, np.int32)
    tree = cKDTree(np.asarray(xyz, np.float32).astype(np.float64))
    thresholds = _compute_thresholds(tree, params)
    counts = tree.query_ball_point(tree.data, thresholds, return_length=True)
    is_leader = counts >= params.beta * np.log(len(xyz))
    components = _connect_leaders(tree, thresholds, is_leader)
    labels = _number_clusters(_assign_followers(tree, thresholds, is_leader, components), params.min_size)
    return _merge_clusters(tree.data, labels, params.gamma) if params.gamma > 0 else labels


def _compute_thresholds(tree: cKDTree, params: EuclideanParams) -> np.ndarray:
    """Compute the thresholds (N,) of Eq. 6 or Eq. 11, rounded to float32."""
    if params.threshold == "global":
        nearest = tree.query(tree.data, k=2)[0][:, 1]  # inf if there is only one point
        mean = np.full(tree.n, nearest.mean() if tree.n > 1 else 0.0)
    else:
        total, count = np.zeros(tree.n), np.zeros(tree.n, np.int64)
        for i, j, squared in _find_neighbours(tree, np.ones(tree.n, bool), params.radius):
            is_neighbour = (i != j) & (squared <= params.radius * params.radius)
            total += np.bincount(i[is_neighbour], np.sqrt(squared[is_neighbour]), tree.n)
            count += np.bincount(i[is_neighbour], minlength=tree.n)
        mean = total / np.maximum(count, 1)
    return (params.alpha * mean).astype(np.float32).astype(np.float64)


def _find_neighbours(tree: cKDTree, is_selected: np.ndarray, radius: float) -> Iterator[tuple]:
    """Yield pairs of neighbours: indices of selected points, indices of points near them, squared distances.

    Some pairs are slightly farther apart than the radius. The search runs in parts to limit memory.
    """
    rows = tree.indices[is_selected[tree.indices]]  # in tree order, so that each part is spatially compact
    if len(rows) == 0:
        return
    count = tree.query_ball_point(tree.data[rows], radius, return_length=True)
    cuts = np.flatnonzero(np.diff(np.cumsum(count) // MAX_NEIGHBOURS)) + 1
    for part in np.split(rows, cuts):
        pairs = cKDTree(tree.data[part]).sparse_distance_matrix(tree, radius * (1 + 1e-9), output_type="ndarray")
        i, j = part[pairs["i"]], pairs["j"]
        offset = tree.data[i] - tree.data[j]
        offset *= offset
        yield i, j, offset[:, 0] + offset[:, 1] + offset[:, 2]


def _connect_leaders(tree: cKDTree, thresholds: np.ndarray, is_leader: np.ndarray) -> np.ndarray:
    """Return the component (N,) of each leader (Eq. 8). Each follower is a separate component."""
    component = np.arange(tree.n)
    for i, j, squared in _find_neighbours(tree, is_leader, thresholds[is_leader].max(initial=0.0)):
        is_linked = is_leader[j] & (squared <= thresholds[i] ** 2)
        edges = component[i[is_linked]], component[j[is_linked]]
        graph = coo_matrix((np.ones(len(edges[0]), bool), edges), (tree.n, tree.n))
        component = connected_components(graph, directed=False)[1][component]
    return component


def _assign_followers(
    tree: cKDTree, thresholds: np.ndarray, is_leader: np.ndarray, component: np.ndarray
) -> np.ndarray:
    """Return the component (N,) of each point, -1 for followers without a leader."""
    result = np.where(is_leader, component, -1)
    for i, j, squared in _find_neighbours(tree, ~is_leader, thresholds[is_leader].max(initial=0.0)):
        is_near = is_leader[j] & (squared <= thresholds[j] ** 2)
        i, j, squared = i[is_near], j[is_near], squared[is_near]
        x, y, z = tree.data[j].T
        order = np.lexsort((z, y, x, squared, i))
        follower, first = np.unique(i[order], return_index=True)
        result[follower] = component[j[order[first]]]
    return result


def _number_clusters(component: np.ndarray, min_size: int = 1) -> np.ndarray:
    """Number the components with at least min_size points from 1 in the order of their first point, (N,) int32."""
    in_cluster = component >= 0
    in_cluster[in_cluster] = np.bincount(component[in_cluster])[component[in_cluster]] >= min_size
    _, first, inverse = np.unique(component[in_cluster], return_index=True, return_inverse=True)
    labels = np.zeros(len(component), np.int32)
    labels[in_cluster] = np.argsort(np.argsort(first))[inverse] + 1
    return labels


def _merge_clusters(points: np.ndarray, labels: np.ndarray, gamma: float) -> np.ndarray:
    """Merge clusters by Eq. 9. The diameter of a cluster is the diagonal of its axis-aligned box."""
    count = labels.max(initial=0)
    if count < 2:
        return labels
    size = np.bincount(labels)[1:]
    centre = np.stack([np.bincount(labels, c)[1:] / size for c in points.T], axis=1)
    order = np.argsort(labels, kind="stable")[np.count_nonzero(labels == 0) :]
    start = np.cumsum(size) - size
    extent = np.maximum.reduceat(points[order], start) - np.minimum.reduceat(points[order], start)
    diameter = np.sqrt((extent**2).sum(axis=1))
    first, second = [], []
    for k in range(count - 1):
        distance = np.sqrt(((centre[k + 1 :] - centre[k]) ** 2).sum(axis=1))
        neighbours = np.flatnonzero(distance < gamma * (diameter[k + 1 :] + diameter[k]) / 2)
        first.append(np.full(len(neighbours), k))
        second.append(neighbours + k + 1)
    pairs = np.concatenate(first), np.concatenate(second)
    graph = coo_matrix((np.ones(len(pairs[0]), bool), pairs), (count, count))
    component = connected_components(graph, directed=False)[1]
    return _number_clusters(np.where(labels > 0, component[labels - 1], -1))
