"""Grouping of points by cluster, in time and memory that do not depend on the ids."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidar_perception.types import InputError


class Groups(NamedTuple):
    """Points of K clusters.

    rows (M,) int64: rows of the points, cluster after cluster, each in the order of the input.
    start (K + 1,) int64: cluster i has rows[start[i]:start[i + 1]].
    numbers (K,) int64: ids of the clusters.
    """

    rows: np.ndarray
    start: np.ndarray
    numbers: np.ndarray

    @property
    def sizes(self) -> np.ndarray:
        """Number of points (K,) of each cluster, at least one."""
        return np.diff(self.start)


def group_by_id(ids: np.ndarray, min_points: int = 1) -> Groups:
    """Group points by id (N,) int, ascending; ids up to 0 mean no cluster.

    Clusters of fewer than min_points points are left out.
    """
    rows = np.flatnonzero(ids > 0)
    rows = rows[np.argsort(ids[rows], kind="stable")]
    ordered = ids[rows]
    cuts = np.flatnonzero(ordered[1:] != ordered[:-1]) + 1
    first = np.concatenate([[0], cuts]) if len(rows) else np.zeros(0, np.int64)
    sizes = np.diff(np.append(first, len(rows)))
    kept = sizes >= min_points
    return Groups(rows[np.repeat(kept, sizes)], _cumulate(sizes[kept]), ordered[first[kept]].astype(np.int64))


def count_clusters(labels: np.ndarray) -> int:
    """Return K, the largest of labels (N,), which are 0 or 1..K.

    Raises:
        InputError: K is larger than N, so that arrays of K rows could exceed the memory.
            renumber_ids() makes ids without gaps.
    """
    count = int(labels.max(initial=0))
    if count > len(labels):
        raise InputError(
            f"a cluster has the id {count}, but there are {len(labels)} points; "
            "number the clusters 1, 2, ... without gaps"
        )
    return count


def group_points(xyz: np.ndarray, labels: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (M, 3) of clusters, cluster after cluster, and the start (K + 1,) of each.

    Args:
        labels: (N,) ids, 0 for no cluster, at most N.
        wanted: (K,) ids of the clusters, without duplicates.
    """
    place = np.full(count_clusters(labels) + 1, -1)
    place[wanted] = np.arange(len(wanted))
    group = place[labels]
    members = np.flatnonzero(group >= 0)
    members = members[np.argsort(group[members], kind="stable")]
    sizes = np.bincount(group[members], minlength=len(wanted))
    return xyz.take(members, axis=0), _cumulate(sizes)


def renumber_ids(ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Renumber cluster ids of any source to 1..K without gaps.

    Ids that are not finite or not above 0 mean no cluster, and so does 2^32 - 1 as uint32, which
    some nodes write for -1.

    Args:
        ids: (N,) integers, or floats with integer values.

    Returns:
        labels (N,) int32, 0 for no cluster, 1..K; and numbers (K,) int64, the original ids,
        ascending.

    Raises:
        InputError: for fractions, for values that float64 cannot hold exactly, and other types.
    """
    ids = np.asarray(ids)
    if ids.dtype.kind == "u" and ids.dtype.itemsize == 4:
        ids = np.where(ids == 2**32 - 1, 0, ids)
    if ids.dtype.kind == "f":
        ids = np.where(np.isfinite(ids) & (ids > 0), ids, 0).astype(np.float64)
        if not (ids == np.floor(ids)).all() or ids.max(initial=0) > 2.0**53:
            raise InputError(
                "the column of cluster ids has values that are not whole numbers; give whole numbers, 0 for no cluster"
            )
    elif ids.dtype.kind not in "iub":
        raise InputError(f"the column of cluster ids is of type {ids.dtype}; give whole numbers")
    ids = ids.astype(np.int64)
    if ids.max(initial=0) <= len(ids):  # counting avoids a sort, as for our own ids
        ids = np.maximum(ids, 0)
        is_used = np.bincount(ids, minlength=1) > 0
        is_used[0] = False
        labels = np.where(is_used, np.cumsum(is_used), 0).astype(np.int32)
        return labels[ids], np.flatnonzero(is_used)
    found = group_by_id(ids)
    labels = np.zeros(len(ids), np.int32)
    labels[found.rows] = np.repeat(np.arange(1, len(found.numbers) + 1), found.sizes)
    return labels, found.numbers


def _cumulate(sizes: np.ndarray) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
