"""Exact DBSCAN on a grid, and the distance-aware DBSCAN of paper A (Section 3.3)."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise

import numpy as np
from numba import njit

from lidar_perception.clustering.dbscan_cells import dbscan_by_cells
from lidar_perception.clustering.dbscan_growth import dbscan_by_growing
from lidar_perception.clustering.grid import find_root
from lidar_perception.clustering.params import DbscanParams
from lidar_perception.clustering.thinning import SLACK, compute_max_exact_distances, thin_points
from lidar_perception.clustering.tree import build_tree, find_touching_labels
from lidar_perception.geometry import counting_sort, horizontal_range


def distance_aware_dbscan(xyz: np.ndarray, params: DbscanParams = DbscanParams()) -> np.ndarray:
    """Cluster each band of horizontal range with its own eps (paper A, Section 3.3).

    Band i is [range_limits[i-1], range_limits[i]). Ids continue from band to band. With join_bands,
    clusters of neighbouring bands are merged if they have points within the smaller eps.

    Args:
        xyz: (N, 3) float32 finite points in the LiDAR frame.

    Returns:
        (N,) int32 ids, 0 for noise, 1..K for the clusters.
    """
    xyz = np.ascontiguousarray(xyz, np.float32)
    order, start = _sort_by_band(xyz, np.asarray(params.range_limits, np.float64))
    bands = [order[a:b] for a, b in pairwise(start)]
    labels = np.zeros(len(xyz), np.int32)
    count = 0
    # The compiled code releases the GIL, so each band runs in its own thread.
    band_ids = _thread_pool().map(
        lambda members, eps: dbscan(xyz.take(members, axis=0), eps, params.min_samples), bands, params.eps
    )
    for members, ids in zip(bands, band_ids):
        labels[members] = np.where(ids > 0, ids + count, 0)
        count += int(ids.max(initial=0))
    return _join_bands(xyz, bands, labels, params.eps) if params.join_bands else labels


@cache
def _thread_pool() -> ThreadPoolExecutor:
    """Return a cached pool: starting threads would take a quarter of the time of a small cloud."""
    return ThreadPoolExecutor(thread_name_prefix="dbscan")


# A forked process does not have its parent's threads.
os.register_at_fork(after_in_child=_thread_pool.cache_clear)


@njit(cache=True, nogil=True)
def _sort_by_band(xyz, limits):
    """Sort points stably by band; return order (N,) and the start (B + 1,) of each band."""
    band = np.empty(len(xyz), np.int64)
    for i in range(len(xyz)):
        # In float32, as horizontal_range computes it.
        distance = np.sqrt(xyz[i, 0] * xyz[i, 0] + xyz[i, 1] * xyz[i, 1])
        band[i] = 0
        while band[i] < len(limits) and limits[band[i]] <= distance:
            band[i] += 1
    return counting_sort(band, len(limits) + 1, np.arange(len(xyz)))


def _join_bands(xyz: np.ndarray, bands: list[np.ndarray], labels: np.ndarray, eps: tuple[float, ...]) -> np.ndarray:
    """Join clusters across neighbouring bands; return labels (N,), renumbered in order.

    bands holds the indices of the points of each band.
    """
    parent = np.arange(int(labels.max(initial=0)) + 1, dtype=np.int32)
    ranges = horizontal_range(xyz)
    clustered_indices = [indices[labels[indices] > 0] for indices in bands]
    for inner, outer, reach in zip(clustered_indices, clustered_indices[1:], map(min, eps, eps[1:])):
        if len(inner) and len(outer):
            inner_range, outer_range = ranges[inner], ranges[outer]
            inner = inner[inner_range >= outer_range.min() - reach]
            outer = outer[outer_range <= inner_range.max() + reach]
            if len(inner) and len(outer):
                _join_labels(parent, _find_touching_clusters(xyz, labels, inner, outer, reach))
    # Components are numbered by their first member; noise (0) is never joined, so it keeps 0.
    return _number_roots(parent)[labels]


@njit(cache=True, nogil=True)
def _join_labels(parent, pairs):
    for k in range(len(pairs)):
        first_root, second_root = find_root(parent, pairs[k, 0]), find_root(parent, pairs[k, 1])
        parent[max(first_root, second_root)] = min(first_root, second_root)


@njit(cache=True, nogil=True)
def _number_roots(parent):
    """Number the sets of a forest 0, 1, ... in the order of their roots.

    Each root must be the lowest item of its set. Returns (S,) int32, the number of each item's set.
    """
    number, count = np.empty(len(parent), np.int32), 0
    for i in range(len(parent)):
        root = find_root(parent, i)
        if root == i:
            number[i] = count
            count += 1
        else:
            number[i] = number[root]
    return number


def _find_touching_clusters(
    xyz: np.ndarray, labels: np.ndarray, inner: np.ndarray, outer: np.ndarray, reach: float
) -> np.ndarray:
    """Find the clusters of two neighbouring bands that have points within reach of each other.

    Args:
        inner: indices of the points of the inner band that may be within reach, at least one.
        outer: the same of the outer band.
        reach: distance in metres.

    Returns:
        (P, 2) pairs of labels. They form a forest that connects all touching clusters, so P is less
        than the number of labels.
    """
    rows = np.concatenate([inner, outer])
    distinct_labels, label = np.unique(labels[rows], return_inverse=True)
    side = (np.arange(len(rows)) >= len(inner)).astype(np.int64)
    tree = build_tree(xyz[rows])
    max_work = compute_max_exact_distances(len(rows))
    pairs, work = find_touching_labels(tree, label[tree.order], side[tree.order], reach * reach, max_work)
    if work > max_work:
        kept_rows, _ = thin_points(xyz[rows], reach, label)
        tree = build_tree(xyz[rows[kept_rows]])
        pairs, _ = find_touching_labels(
            tree, label[kept_rows][tree.order], side[kept_rows][tree.order], (reach * (1 + SLACK)) ** 2, np.inf
        )
    return distinct_labels[pairs]


def dbscan(xyz: np.ndarray, eps: float, min_samples: int) -> np.ndarray:
    """Cluster finite points (N, 3) by DBSCAN.

    Clusters are numbered by their first core point. A border point between clusters joins the first
    one. All labels, including those of border points, are those of scikit-learn's DBSCAN plus one.

    Returns:
        (N,) int32 labels: 0 for noise, 1..K for the clusters.
    """
    if len(xyz) == 0:
        return np.zeros(0, np.int32)
    xyz = np.ascontiguousarray(xyz, np.float32)
    labels = dbscan_by_growing(xyz, eps, min_samples)
    return dbscan_by_cells(xyz, eps, min_samples) if labels is None else labels
