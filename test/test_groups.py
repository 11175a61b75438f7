"""Points by cluster, by whatever numbers a clustering gives."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import each_make, header

from lidar_perception.clustering.shapes import fit_boxes, fit_ellipses
from lidar_perception.groups import cluster_count, group_points, groups_of, renumbered
from lidar_perception.types import InputError
from lidar_perception.wire.messages import read_cluster_ids
from msg_utils.point_cloud2 import from_array

ids = st.lists(st.sampled_from([-2**31, -1, 0, 1, 2, 3, 7, 2**31, 2**32 - 1]), max_size=30)


def plain(values):
    """labels and numbers by the meaning of the words."""
    numbers = sorted({int(v) for v in values if np.isfinite(v) and v > 0})
    return [numbers.index(v) + 1 if v in numbers else 0 for v in values], numbers


@given(ids, st.sampled_from(["i8", "f8"]))
def test_clusters_are_numbered_without_a_gap_in_the_order_of_their_ids(values, kind):
    labels, numbers = renumbered(np.array(values, kind))
    assert (labels.tolist(), numbers.tolist()) == plain(values)
    assert (labels.dtype, numbers.dtype) == (np.int32, np.int64)


@pytest.mark.parametrize("kind", ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8", ">u4", ">f4"])
def test_ids_of_every_type_a_cloud_can_have_are_read(kind):
    values = np.array([0, 3, 1, 3, 100], kind)
    assert [x.tolist() for x in renumbered(values)] == [[0, 2, 1, 2, 3], [1, 3, 100]]


def test_what_is_not_finite_is_in_no_cluster_and_fractions_are_refused():
    labels, numbers = renumbered(np.float32([np.nan, 5, np.inf, -np.inf, -3, 0, 2]))
    assert labels.tolist() == [0, 2, 0, 0, 0, 0, 1] and numbers.tolist() == [2, 5]
    assert renumbered(np.array([2**32 - 1, 2**32 - 2], "u4"))[0].tolist() == [0, 1]  # -1 is noise
    for wrong in ([1.5], [1e30], [2.0**53 + 2]):
        with pytest.raises(InputError, match="no ids"):
            renumbered(np.array(wrong))


@given(ids, st.integers(1, 3))
def test_groups_hold_each_point_of_a_cluster_once_in_order(values, least):
    values = np.array(values, np.int64)
    found = groups_of(values, least)
    kept = [k for k in np.unique(values) if k > 0 and (values == k).sum() >= least]
    assert found.numbers.tolist() == kept
    parts = [found.rows[a:b].tolist() for a, b in zip(found.start, found.start[1:])]
    assert parts == [np.flatnonzero(values == k).tolist() for k in kept]


@given(ids)
def test_group_points_takes_the_clusters_wanted_as_groups_of_has_them(values):
    labels, numbers = renumbered(np.array(values, np.int64))
    xyz = np.arange(3 * len(labels), dtype=np.float32).reshape(-1, 3)
    found = groups_of(labels)
    points, start = group_points(xyz, labels, np.arange(1, len(numbers) + 1))
    assert np.array_equal(points, xyz[found.rows]) and np.array_equal(start, found.start)


def test_memory_follows_the_points_and_not_the_largest_id():
    def peak(largest):
        values = np.arange(3600, dtype=np.uint32)
        values[7] = largest
        tracemalloc.start()
        renumbered(values)
        found = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return found
    assert peak(2**32 - 2) < 100 * 3600 and peak(30_000_000) < 100 * 3600


@each_make
def test_the_column_of_a_cloud_is_read_at_the_places_asked_for(make):
    cloud = np.zeros(5, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("cluster_id", "<u4")])
    cloud["cluster_id"] = [9, 4_000_000_000, 0, 9, 2]
    msg = from_array(cloud, header(make), make)
    labels, numbers = read_cluster_ids(msg, np.array([1, 2, 3]))
    assert labels.tolist() == [2, 0, 1] and numbers.tolist() == [9, 4_000_000_000]
    without_ids = from_array(cloud[["x"]].copy(), header(make), make)
    assert read_cluster_ids(without_ids, np.arange(5)) is None


@pytest.mark.parametrize("size_by_id", [
    cluster_count, lambda ids: fit_boxes(np.zeros((len(ids), 3), np.float32), ids, "min_area"),
    lambda ids: fit_ellipses(np.zeros((len(ids), 3), np.float32), ids),
    lambda ids: group_points(np.zeros((len(ids), 3)), ids, np.array([1]))],
    ids=["cluster_count", "fit_boxes", "fit_ellipses", "group_points"])
def test_where_rows_are_counted_by_the_largest_id_it_takes_no_memory(size_by_id):
    size_by_id(np.array([0, 1, 2, 3, 3], np.int32))
    tracemalloc.start()
    with pytest.raises(InputError, match="without gaps"):
        size_by_id(np.array([0, 1, 2, 3, 2**31 - 1], np.int32))
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()
