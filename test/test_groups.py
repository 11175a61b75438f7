"""Points grouped by cluster, for ids of any clustering."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import each_make, make_any_header

from lidar_perception.clustering.shapes import fit_boxes, fit_ellipses
from lidar_perception.groups import count_clusters, group_by_id, group_points, renumber_ids
from lidar_perception.types import InputError
from lidar_perception.wire.messages import read_cluster_ids
from msg_utils.point_cloud2 import from_array

ids = st.lists(st.sampled_from([-(2**31), -1, 0, 1, 2, 3, 7, 2**31, 2**32 - 1]), max_size=30)


def number_ids_slowly(values):
    """Return labels and counts of a plain implementation."""
    numbers = sorted({int(v) for v in values if np.isfinite(v) and v > 0})
    return [numbers.index(v) + 1 if v in numbers else 0 for v in values], numbers


@given(ids, st.sampled_from(["i8", "f8"]))
def test_clusters_are_renumbered_without_gaps(values, kind):
    labels, numbers = renumber_ids(np.array(values, kind))
    assert (labels.tolist(), numbers.tolist()) == number_ids_slowly(values)
    assert (labels.dtype, numbers.dtype) == (np.int32, np.int64)


@pytest.mark.parametrize("kind", ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8", ">u4", ">f4"])
def test_ids_of_every_field_type_are_read(kind):
    values = np.array([0, 3, 1, 3, 100], kind)
    assert [x.tolist() for x in renumber_ids(values)] == [[0, 2, 1, 2, 3], [1, 3, 100]]


def test_ids_that_are_not_finite_mean_no_cluster():
    labels, numbers = renumber_ids(np.float32([np.nan, 5, np.inf, -np.inf, -3, 0, 2]))
    assert labels.tolist() == [0, 2, 0, 0, 0, 0, 1] and numbers.tolist() == [2, 5]
    assert renumber_ids(np.array([2**32 - 1, 2**32 - 2], "u4"))[0].tolist() == [0, 1]  # -1 is noise


@pytest.mark.parametrize("value", [1.5, 1e30, 2.0**53 + 2])
def test_ids_that_are_not_integers_are_rejected(value):
    with pytest.raises(InputError, match="not whole numbers"):
        renumber_ids(np.array([value]))


@given(ids, st.integers(1, 3))
def test_group_by_id_keeps_the_order_of_points(values, min_points):
    values = np.array(values, np.int64)
    found = group_by_id(values, min_points)
    large_ids = [k for k in np.unique(values) if k > 0 and (values == k).sum() >= min_points]
    assert found.numbers.tolist() == large_ids
    parts = [found.rows[a:b].tolist() for a, b in zip(found.start, found.start[1:])]
    assert parts == [np.flatnonzero(values == k).tolist() for k in large_ids]


@given(ids)
def test_group_points_agrees_with_group_by_id(values):
    labels, numbers = renumber_ids(np.array(values, np.int64))
    xyz = np.arange(3 * len(labels), dtype=np.float32).reshape(-1, 3)
    found = group_by_id(labels)
    points, start = group_points(xyz, labels, np.arange(1, len(numbers) + 1))
    assert np.array_equal(points, xyz[found.rows]) and np.array_equal(start, found.start)


def test_memory_depends_on_the_points_not_on_the_ids():
    def measure_peak(largest):
        values = np.arange(3600, dtype=np.uint32)
        values[7] = largest
        tracemalloc.start()
        renumber_ids(values)
        found = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return found

    assert measure_peak(2**32 - 2) < 100 * 3600 and measure_peak(30_000_000) < 100 * 3600


@each_make
def test_cluster_column_reads_the_given_rows(make):
    cloud = np.zeros(5, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("cluster_id", "<u4")])
    cloud["cluster_id"] = [9, 4_000_000_000, 0, 9, 2]
    msg = from_array(cloud, make_any_header(make), make)
    labels, numbers = read_cluster_ids(msg, np.array([1, 2, 3]))
    assert labels.tolist() == [2, 0, 1] and numbers.tolist() == [9, 4_000_000_000]
    without_ids = from_array(cloud[["x"]].copy(), make_any_header(make), make)
    assert read_cluster_ids(without_ids, np.arange(5)) is None


@pytest.mark.parametrize(
    "size_by_id",
    [
        count_clusters,
        lambda ids: fit_boxes(np.zeros((len(ids), 3), np.float32), ids, "min_area"),
        lambda ids: fit_ellipses(np.zeros((len(ids), 3), np.float32), ids),
        lambda ids: group_points(np.zeros((len(ids), 3)), ids, np.array([1])),
    ],
    ids=["count_clusters", "fit_boxes", "fit_ellipses", "group_points"],
)
def test_huge_id_is_rejected_before_memory_is_allocated(size_by_id):
    size_by_id(np.array([0, 1, 2, 3, 3], np.int32))
    tracemalloc.start()
    with pytest.raises(InputError, match="without gaps"):
        size_by_id(np.array([0, 1, 2, 3, 2**31 - 1], np.int32))
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()
