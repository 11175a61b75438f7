"""Exact DBSCAN on a grid, and the distance-aware DBSCAN of paper A."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise

import numpy as np
from numba import njit
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from lidar_perception.clustering.dense import dbscan_by_cells
from lidar_perception.clustering.growing import dbscan_by_growing
from lidar_perception.clustering.params import DbscanParams
from lidar_perception.clustering.thinned import SLACK, patience, thinned
from lidar_perception.clustering.tree import touching, tree_of
from lidar_perception.geometry import horizontal_range, stable_order


def distance_aware_dbscan(xyz: np.ndarray, params: DbscanParams = DbscanParams()) -> np.ndarray:
    """(N,) int32 cluster ids of finite points (N, 3) float32 in the LiDAR frame; 0 is noise.

    Each band of horizontal range [range_limits[i-1], range_limits[i]) is clustered by itself with
    eps[i]; ids go on from band to band (paper A, Section 3.3). With join_bands, clusters of
    neighbouring bands that have points within the smaller eps of each other become one.
    """
    xyz = np.ascontiguousarray(xyz, np.float32)
    order, start = _by_band(xyz, np.asarray(params.range_limits, np.float64))
    bands = [order[a:b] for a, b in pairwise(start)]
    labels = np.zeros(len(xyz), np.int32)
    last = 0
    # The compiled code lets go of the GIL: each band has a thread.
    found = _threads().map(lambda members, eps: dbscan(xyz.take(members, axis=0), eps,
                                                       params.min_samples), bands, params.eps)
    for members, ids in zip(bands, found):
        labels[members] = np.where(ids > 0, ids + last, 0)
        last += int(ids.max(initial=0))
    return _joined(xyz, bands, labels, params.eps) if params.join_bands else labels


@cache
def _threads() -> ThreadPoolExecutor:
    """Kept: to start them anew takes a quarter of the time of a small cloud."""
    return ThreadPoolExecutor(thread_name_prefix="dbscan")


# A forked process has none of its parent's threads.
os.register_at_fork(after_in_child=_threads.cache_clear)


@njit(cache=True, nogil=True)
def _by_band(xyz, limits):
    """order (N,): the points of each band of horizontal range, in their order, band by band; and
    start (B + 1,) of each band."""
    band = np.empty(len(xyz), np.int64)
    for i in range(len(xyz)):
        away = np.sqrt(xyz[i, 0] * xyz[i, 0] + xyz[i, 1] * xyz[i, 1])  # float32: horizontal_range
        band[i] = np.searchsorted(limits, away, side="right")
    return stable_order(band, len(limits) + 1, np.arange(len(xyz)))


def _joined(xyz: np.ndarray, bands: list[np.ndarray], labels: np.ndarray,
            eps: tuple[float, ...]) -> np.ndarray:
    """labels (N,) with clusters joined across neighbouring bands, numbered anew in order; bands
    hold the indices of their points."""
    count = int(labels.max(initial=0))
    pairs = [np.zeros((0, 2), np.int64)]
    clustered = [indices[labels[indices] > 0] for indices in bands]
    for inner, outer, reach in zip(clustered, clustered[1:], map(min, eps, eps[1:])):
        if len(inner) and len(outer):
            pairs.append(_touching(xyz, labels, inner, outer, reach))
    joined = np.unique(np.concatenate(pairs), axis=0)
    graph = coo_matrix((np.ones(len(joined)), joined.T), shape=(count + 1, count + 1))
    _, component = connected_components(graph, directed=False)
    # Components are numbered by their first member; 0, the noise, is joined with nothing.
    return component[labels].astype(np.int32)


def _touching(xyz: np.ndarray, labels: np.ndarray, inner: np.ndarray, outer: np.ndarray,
              reach: float) -> np.ndarray:
    """(P, 2) labels that connect what pairs of points connect, one of each band, within reach of
    each other; P is less than the number of labels."""
    inner_range, outer_range = (horizontal_range(xyz[side]) for side in (inner, outer))
    inner = inner[inner_range >= outer_range.min() - reach]
    outer = outer[outer_range <= inner_range.max() + reach]
    if len(inner) == 0 or len(outer) == 0:
        return np.zeros((0, 2), np.int64)
    rows = np.concatenate([inner, outer])
    known, label = np.unique(labels[rows], return_inverse=True)
    side = (np.arange(len(rows)) >= len(inner)).astype(np.int64)
    tree = tree_of(xyz[rows])
    most_work = patience(len(rows))
    pairs, work = touching(tree, label[tree.order], side[tree.order], reach * reach, most_work)
    if work > most_work:
        kept, _ = thinned(xyz[rows], reach, label)
        tree = tree_of(xyz[rows[kept]])
        pairs, _ = touching(tree, label[kept][tree.order], side[kept][tree.order],
                            (reach * (1 + SLACK)) ** 2, np.inf)
    return known[pairs]


def dbscan(xyz: np.ndarray, eps: float, min_samples: int) -> np.ndarray:
    """(N,) int32 labels of finite points (N, 3): 0 noise, clusters 1..K.

    The labels are those of scikit-learn's DBSCAN plus one, border points included: clusters are
    numbered by their first core point, and a border point between clusters goes to the first.
    """
    if len(xyz) == 0:
        return np.zeros(0, np.int32)
    xyz = np.ascontiguousarray(xyz, np.float32)
    labels = dbscan_by_growing(xyz, eps, min_samples)
    return dbscan_by_cells(xyz, eps, min_samples) if labels is None else labels
