"""Grouping of points by cluster, with time and memory independent of the values of the ids."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidar_perception.types import InputError


class Groups(NamedTuple):
    """Points of K clusters.

    Attributes:
        rows: (M,) int64 rows of the points, cluster after cluster, each in the order of the input.
        start: (K + 1,) int64; cluster i has rows[start[i]:start[i + 1]].
        numbers: (K,) int64 ids of the clusters, ascending.
    """

    rows: np.ndarray
    start: np.ndarray
    numbers: np.ndarray

    @property
    def sizes(self) -> np.ndarray:
        """Number of points (K,) of each cluster, at least one."""
        return np.diff(self.start)


def group_by_id(ids: np.ndarray, min_points: int = 1) -> Groups:
    """Group points by their ids (N,) int, in ascending order.

    Points with ids <= 0 and clusters of fewer than min_points points are left out.
    """
    rows = np.flatnonzero(ids > 0)
    rows = rows[np.argsort(ids[rows], kind="stable")]
    sorted_ids = ids[rows]
    cuts = np.flatnonzero(sorted_ids[1:] != sorted_ids[:-1]) + 1
    first = np.concatenate([[0], cuts]) if len(rows) else np.zeros(0, np.int64)
    sizes = np.diff(np.append(first, len(rows)))
    is_kept = sizes >= min_points
    return Groups(
        rows[np.repeat(is_kept, sizes)], _cumulate(sizes[is_kept]), sorted_ids[first[is_kept]].astype(np.int64)
    )


def count_clusters(labels: np.ndarray) -> int:
    """Return the number of clusters K.

    Args:
        labels: (N,) cluster id of each point, 1 to K, or 0 for none.

    Raises:
        InputError: K is larger than N, so arrays with K rows could exceed the memory. Call
            renumber_ids() first to close the gaps.
    """
    count = int(labels.max(initial=0))
    if count > len(labels):
        raise InputError(
            f"a cluster has the id {count}, but there are {len(labels)} points; "
            "number the clusters 1, 2, ... without gaps"
        )
    return count


def group_points(xyz: np.ndarray, labels: np.ndarray, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Collect the points of some clusters.

    Args:
        xyz: (N, 3) points.
        labels: (N,) cluster id of each point, at most N, 0 for no cluster.
        ids: (K,) ids of the clusters, without duplicates.

    Returns:
        The points (M, 3), cluster after cluster, and the starts (K + 1,) of the clusters.
    """
    group_by_id = np.full(count_clusters(labels) + 1, -1)
    group_by_id[ids] = np.arange(len(ids))
    groups = group_by_id[labels]
    members = np.flatnonzero(groups >= 0)
    members = members[np.argsort(groups[members], kind="stable")]
    sizes = np.bincount(groups[members], minlength=len(ids))
    return xyz.take(members, axis=0), _cumulate(sizes)


def renumber_ids(ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Renumber cluster ids from any source to 1..K without gaps.

    Ids that are not finite or not positive mean no cluster; so does 2^32 - 1 as uint32, which some
    nodes write for -1.

    Args:
        ids: (N,) integers, or floats with integer values.

    Returns:
        labels: (N,) int32, 1..K, 0 for no cluster.
        numbers: (K,) int64 original ids, ascending.

    Raises:
        InputError: an id has a fraction or is too large for float64 to hold exactly, or the type of
            the ids is not numeric.
    """
    ids = np.asarray(ids)
    if ids.dtype.kind == "u" and ids.dtype.itemsize == 4:
        ids = np.where(ids == 2**32 - 1, 0, ids)
    if ids.dtype.kind == "f":
        ids = np.where(np.isfinite(ids) & (ids > 0), ids, 0).astype(np.float64)
        if not (ids == np.floor(ids)).all() or ids.max(initial=0) > 2.0**53:
            raise InputError(
                "the column of cluster ids has values that are not whole numbers; write whole numbers, 0 for no cluster"
            )
    elif ids.dtype.kind not in "iub":
        raise InputError(f"the column of cluster ids has the type {ids.dtype}; write whole numbers")
    ids = ids.astype(np.int64)
    if ids.max(initial=0) <= len(ids):  # true for ids of this package; counting avoids a sort
        ids = np.maximum(ids, 0)
        is_used = np.bincount(ids, minlength=1) > 0
        is_used[0] = False
        labels = np.where(is_used, np.cumsum(is_used), 0).astype(np.int32)
        return labels[ids], np.flatnonzero(is_used)
    groups = group_by_id(ids)
    labels = np.zeros(len(ids), np.int32)
    labels[groups.rows] = np.repeat(np.arange(1, len(groups.numbers) + 1), groups.sizes)
    return labels, groups.numbers


def _cumulate(sizes: np.ndarray) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
