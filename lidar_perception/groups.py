"""Points by cluster, one cluster after the other. Time and memory follow the number of points,
whatever the numbers of the clusters."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidar_perception.types import InputError


class Groups(NamedTuple):
    """The points of K clusters: rows (M,) int64, one cluster after the other and in their order in
    each; those of the i-th from start[i] to start[i + 1], start (K + 1,) int64. numbers (K,) int64:
    what the clusters are called."""

    rows: np.ndarray
    start: np.ndarray
    numbers: np.ndarray

    @property
    def sizes(self) -> np.ndarray:
        """(K,) points of each, at least one."""
        return np.diff(self.start)


def groups_of(ids: np.ndarray, min_points: int = 1) -> Groups:
    """The clusters of at least min_points among points with ids (N,) of integers, ascending by
    number; 0 and below belong to none."""
    rows = np.flatnonzero(ids > 0)
    rows = rows[np.argsort(ids[rows], kind="stable")]
    ordered = ids[rows]
    cuts = np.flatnonzero(ordered[1:] != ordered[:-1]) + 1
    first = np.concatenate([[0], cuts]) if len(rows) else np.zeros(0, np.int64)
    sizes = np.diff(np.append(first, len(rows)))
    kept = sizes >= min_points
    return Groups(rows[np.repeat(kept, sizes)], _starts(sizes[kept]),
                  ordered[first[kept]].astype(np.int64))


def cluster_count(labels: np.ndarray) -> int:
    """K of labels (N,), 1..K for the clusters, where arrays of K rows are made. InputError if K is
    larger than N, which renumbered() prevents: an id must not say how much memory is taken."""
    count = int(labels.max(initial=0))
    if count > len(labels):
        raise InputError(f"a cluster has the id {count}, but there are {len(labels)} points; "
                         "number the clusters 1, 2, ... without gaps")
    return count


def group_points(xyz: np.ndarray, labels: np.ndarray,
                 wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """points (M, 3) of the clusters `wanted` (K,), each named once, one cluster after the other,
    and start (K + 1,) where each begins. labels (N,) are 0 for none, 1..N at most."""
    place = np.full(cluster_count(labels) + 1, -1)
    place[wanted] = np.arange(len(wanted))
    group = place[labels]
    members = np.flatnonzero(group >= 0)
    members = members[np.argsort(group[members], kind="stable")]
    sizes = np.bincount(group[members], minlength=len(wanted))
    return xyz.take(members, axis=0), _starts(sizes)


def renumbered(ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """labels (N,) int32, 0 none and 1..K without a gap, of ids (N,) from anywhere, and numbers (K,)
    int64: the id of each, ascending. 0, what is below, and what is not finite is none; so is
    2^32 - 1 as uint32, the -1 of those who mean noise. InputError for fractions, and beyond what a
    float64 holds exactly."""
    ids = np.asarray(ids)
    if ids.dtype.kind == "u" and ids.dtype.itemsize == 4:
        ids = np.where(ids == 2**32 - 1, 0, ids)
    if ids.dtype.kind == "f":
        ids = np.where(np.isfinite(ids) & (ids > 0), ids, 0).astype(np.float64)
        if not (ids == np.floor(ids)).all() or ids.max(initial=0) > 2.0**53:
            raise InputError("the column of cluster ids holds numbers that are no ids; give whole "
                             "numbers, 0 for no cluster")
    elif ids.dtype.kind not in "iub":
        raise InputError(f"the column of cluster ids is of type {ids.dtype}; give whole numbers")
    ids = ids.astype(np.int64)
    if ids.max(initial=0) <= len(ids):  # as ours are: no need to sort them
        ids = np.maximum(ids, 0)
        there = np.bincount(ids, minlength=1) > 0
        there[0] = False
        return np.where(there, np.cumsum(there), 0).astype(np.int32)[ids], np.flatnonzero(there)
    found = groups_of(ids)
    labels = np.zeros(len(ids), np.int32)
    labels[found.rows] = np.repeat(np.arange(1, len(found.numbers) + 1), found.sizes)
    return labels, found.numbers


def _starts(sizes: np.ndarray) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
