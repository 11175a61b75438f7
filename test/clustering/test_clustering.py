"""DBSCAN and distance-aware DBSCAN, compared with scikit-learn's DBSCAN."""

from __future__ import annotations

import multiprocessing

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import DATA, needs_data
from scipy.spatial import cKDTree
from sklearn.cluster import DBSCAN

from lidar_perception.clustering.dbscan import dbscan, distance_aware_dbscan
from lidar_perception.clustering.dbscan_cells import dbscan_by_cells
from lidar_perception.clustering.dbscan_growth import dbscan_by_growing
from lidar_perception.clustering.params import DbscanParams
from lidar_perception.ground.threshold import segment_by_threshold

pytestmark = pytest.mark.no_cover  # covered by other tests

SCANS = DATA / "kitti_object/training/velodyne_reduced"


def cluster_by_sklearn(xyz, eps, min_samples):
    """Return scikit-learn's labels plus 1, so that noise is 0. Like our code, it computes in float64."""
    if len(xyz) == 0:
        return np.zeros(0, np.int32)
    model = DBSCAN(eps=eps, min_samples=min_samples, algorithm="kd_tree")
    return model.fit_predict(np.asarray(xyz, np.float64)) + 1


def find_core_points(xyz, eps, min_samples):
    tree = cKDTree(np.asarray(xyz, np.float64))
    return tree.query_ball_point(tree.data, eps, return_length=True) >= min_samples


def to_partition(labels):
    """Return the clusters as a set of sets of indices, without their ids."""
    return {frozenset(np.flatnonzero(labels == k).tolist()) for k in np.unique(labels) if k > 0}


def make_blobs(rng, centres, size, spread):
    """Return points (N, 3) float32 around centres (K, 3), and the index of each point's centre."""
    centres = np.asarray(centres, float)
    xyz = np.repeat(centres, size, axis=0) + rng.uniform(-spread, spread, (size * len(centres), 3))
    return xyz.astype(np.float32), np.repeat(np.arange(len(centres)), size)


def assert_same(xyz, eps, min_samples):
    result = dbscan(xyz, eps, min_samples)
    assert result.dtype == np.int32 and result.shape == (len(xyz),)
    np.testing.assert_array_equal(result, cluster_by_sklearn(xyz, eps, min_samples))


@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 400),
    st.floats(0.05, 1.5),
    st.integers(1, 12),
    st.sampled_from([0.0, 50.0, 3000.0]),
)
def test_labels_equal_sklearn_on_random_points(seed, count, eps, min_samples, offset):
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-2, 2, (count, 3)) * rng.choice([0.1, 1.0, 2.0], 3) + offset
    assert_same(xyz.astype(np.float32), eps, min_samples)


@given(st.integers(0, 2**32 - 1), st.integers(1, 500), st.integers(1, 4), st.integers(1, 30))
def test_labels_equal_sklearn_with_many_equal_distances(seed, count, reach, min_samples):
    # Multiples of 1/4, so that distances are exact and many equal eps.
    xyz = np.random.default_rng(seed).integers(-6, 7, (count, 3)).astype(np.float32) / 4
    assert_same(xyz, reach / 4, min_samples)


@pytest.mark.parametrize("min_samples", [2, 5, 6, 7, 27])
def test_border_points_join_the_first_cluster(min_samples):
    # Dense balls that are so close together that most border points belong to two of them.
    rng = np.random.default_rng(3)
    xyz, _ = make_blobs(rng, [[0, 0, 0], [0.9, 0, 0], [0, 0.9, 0], [0.9, 0.9, 0.2]], 40, 0.25)
    bridge = rng.uniform(-0.2, 1.1, (60, 3)).astype(np.float32)
    points = rng.permutation(np.concatenate([xyz, bridge]))
    for eps in (0.15, 0.25, 0.35):
        assert_same(points, eps, min_samples)


@pytest.mark.parametrize(
    "name, xyz",
    [
        ("empty", np.zeros((0, 3))),
        ("one point", np.ones((1, 3))),
        ("all equal", np.full((50, 3), 7.3)),
        ("at the origin", np.zeros((50, 3))),
        ("two indices", np.repeat([[0.0, 0, 0], [1, 1, 1]], 20, axis=0)),
        ("two indices within eps", np.repeat([[0.0, 0, 0], [0.25, 0, 0]], 20, axis=0)),
        ("two clusters at one place", np.concatenate([np.eye(3)] * 10)),
        ("line", np.linspace(0, 8, 33)[:, None] * [1, 0, 0]),
        ("slanted line", np.linspace(0, 8, 65)[:, None] * [1, 2, -3]),
        ("column", np.linspace(0, 8, 129)[:, None] * [0, 0, 1]),
        ("plane", np.stack([*np.mgrid[0:4:0.25, 0:4:0.25], np.zeros((16, 16))], -1).reshape(-1, 3)),
    ],
)
@pytest.mark.parametrize("min_samples", [1, 2, 3, 10, 100])
def test_labels_equal_sklearn_on_degenerate_clouds(name, xyz, min_samples):
    for eps in (0.125, 0.25, 0.5):
        assert_same(np.asarray(xyz, np.float32), eps, min_samples)


@needs_data
@pytest.mark.parametrize("scan", [0, 11, 23])
def test_labels_equal_sklearn_on_real_clouds(scan):
    raw = np.fromfile(sorted(SCANS.glob("*.bin"))[scan], np.float32).reshape(-1, 4)
    xyz = raw[:, :3][~segment_by_threshold(np.ascontiguousarray(raw[:, :3]))]
    params = DbscanParams()
    result = distance_aware_dbscan(xyz, params)
    assert result.max() > 20
    np.testing.assert_array_equal(result, cluster_bands_by_sklearn(xyz, params))


def cluster_bands_by_sklearn(xyz, params):
    """Cluster each band with scikit-learn and number the clusters consecutively; ranges are float32."""
    limits = [-np.inf, *params.range_limits, np.inf]
    ranges = np.sqrt(xyz[:, 0] * xyz[:, 0] + xyz[:, 1] * xyz[:, 1])
    labels, last = np.zeros(len(xyz), int), 0
    for low, high, eps in zip(limits, limits[1:], params.eps):
        members = (ranges >= low) & (ranges < high)
        result = cluster_by_sklearn(xyz[members], eps, params.min_samples)
        labels[members] = np.where(result > 0, result + last, 0)
        last = labels.max(initial=0)
    return labels


@given(st.integers(0, 2**32 - 1), st.integers(0, 600), st.integers(1, 8))
def test_distance_aware_dbscan_equals_sklearn_in_each_band(seed, count, min_samples):
    rng = np.random.default_rng(seed)
    xyz = (rng.uniform(-6, 6, (count, 3)) * [1, 1, 0.2]).astype(np.float32)
    params = DbscanParams(range_limits=(2.0, 3.5, 5.0), eps=(0.2, 0.5, 0.3, 0.8), min_samples=min_samples)
    np.testing.assert_array_equal(distance_aware_dbscan(xyz, params), cluster_bands_by_sklearn(xyz, params))


@pytest.mark.parametrize("limit, at", [(15.0, [15, 0]), (15.0, [0, -15]), (15.0, [9, 12]), (30.0, [-18, 24])])
def test_point_at_a_range_limit_is_in_the_far_band(limit, at):
    # Points 0.25 m apart form a cluster only beyond the limit, where eps is larger.
    at = np.array([*at, 0], np.float32)
    inner = at * np.float32(1 - 1e-6)
    assert np.hypot(*inner[:2]) < limit
    params = DbscanParams(range_limits=(limit,), eps=(0.15, 0.30), min_samples=2)
    up = np.array([0, 0, 0.25], np.float32)
    assert distance_aware_dbscan(np.stack([at, at + up]), params).tolist() == [1, 1]
    assert distance_aware_dbscan(np.stack([inner, inner + up]), params).tolist() == [0, 0]
    assert distance_aware_dbscan(np.stack([inner, at + up]), params).tolist() == [0, 0]


def test_cluster_across_a_range_limit_is_split():
    xyz = np.zeros((200, 3), np.float32)
    xyz[:, 0] = np.linspace(14, 16, 200)
    labels = distance_aware_dbscan(xyz, DbscanParams())
    assert labels.tolist() == [1] * int((xyz[:, 0] < 15).sum()) + [2] * int((xyz[:, 0] >= 15).sum())


JOIN = DbscanParams(join_bands=True)


def join_bands_slowly(xyz, labels, params):
    """Join clusters of neighbouring bands with a pair of points within the smaller eps."""
    band = np.searchsorted(params.range_limits, np.hypot(*xyz[:, :2].T.astype(np.float32)), "right")
    joined = {frozenset([k]) for k in range(1, labels.max(initial=0) + 1)}
    for i, j in zip(*np.nonzero(np.abs(band[:, None] - band) == 1)):
        reach = min(params.eps[band[i]], params.eps[band[j]])
        if labels[i] and labels[j] and np.linalg.norm(xyz[i].astype(float) - xyz[j]) <= reach:
            both = {s for s in joined if labels[i] in s or labels[j] in s}
            joined = joined - both | {frozenset().union(*both)}
    return {frozenset(np.flatnonzero(np.isin(labels, [*s])).tolist()) for s in joined}


@given(st.integers(0, 2**32 - 1), st.integers(0, 150))
def test_join_bands_joins_only_touching_clusters(seed, count):
    rng = np.random.default_rng(seed)
    xyz = (rng.uniform(-6, 6, (count, 3)) * [1, 1, 0.1]).astype(np.float32)
    params = DbscanParams(range_limits=(2.0, 4.0), eps=(0.9, 0.7, 1.0), min_samples=3)
    labels = distance_aware_dbscan(xyz, params)
    result = distance_aware_dbscan(xyz, DbscanParams(params.range_limits, params.eps, 3, join_bands=True))
    assert to_partition(result) == join_bands_slowly(xyz, labels, params)
    np.testing.assert_array_equal(result > 0, labels > 0)
    first = [np.flatnonzero(result == k)[0] for k in range(1, result.max(initial=0) + 1)]
    assert len(set(result.tolist()) - {0}) == len(first)


def test_join_bands_reunites_a_cluster_across_a_limit():
    xyz = np.zeros((200, 3), np.float32)
    xyz[:, 0] = np.linspace(14, 16, 200)
    assert distance_aware_dbscan(xyz, JOIN).tolist() == [1] * 200
    gap = xyz[(xyz[:, 0] < 14.9) | (xyz[:, 0] > 15.1)]  # a gap of 0.2 m, more than the smaller eps
    assert distance_aware_dbscan(gap, JOIN).max() == 2


def test_distance_aware_without_limits_is_plain_dbscan():
    xyz = np.random.default_rng(1).uniform(-20, 20, (2000, 3)).astype(np.float32)
    params = DbscanParams(range_limits=(), eps=(2.0,), min_samples=4)
    np.testing.assert_array_equal(distance_aware_dbscan(xyz, params), dbscan(xyz, 2.0, 4))


@pytest.mark.parametrize("far", [[1e5, 0, 0], [0, -1e5, 0], [0, 0, 1e5], [-7e4, 7e4, -1e3]])
def test_outlier_100_km_away_does_not_change_clusters(far):
    xyz = np.random.default_rng(7).uniform(-2, 2, (800, 3)).astype(np.float32)
    labels = dbscan(xyz, 0.4, 5)
    for place in (0, 400, 800):
        result = dbscan(np.insert(xyz, place, np.float32(far), axis=0), 0.4, 5)
        assert result[place] == 0
        np.testing.assert_array_equal(np.delete(result, place), labels)
    banded = distance_aware_dbscan(np.concatenate([xyz, np.float32([far])]))
    np.testing.assert_array_equal(banded[:-1], distance_aware_dbscan(xyz))


def test_clusters_100_km_away_are_found_like_near_ones():
    # Steps of 1/64 m are exact in float32 at that distance.
    rng = np.random.default_rng(8)
    xyz = (rng.integers(-64, 64, (400, 3)) / 64).astype(np.float32)
    distant_xyz = xyz + np.float32([8e4, -6e4, 16])
    np.testing.assert_array_equal(dbscan(distant_xyz, 0.25, 5), cluster_by_sklearn(distant_xyz, 0.25, 5))
    assert to_partition(dbscan(distant_xyz, 0.25, 5)) == to_partition(dbscan(xyz, 0.25, 5))


@given(st.integers(0, 2**32 - 1), st.integers(1, 300), st.integers(1, 8))
def test_ids_are_1_to_K_by_first_core_point(seed, count, min_samples):
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-2, 2, (count, 3)).astype(np.float32)
    labels = dbscan(xyz, 0.5, min_samples)
    core = find_core_points(xyz, 0.5, min_samples)
    assert np.unique(labels[labels > 0]).tolist() == list(range(1, labels.max() + 1))
    firsts = [np.flatnonzero(core & (labels == k))[0] for k in range(1, labels.max() + 1)]
    assert firsts == sorted(firsts)
    banded = distance_aware_dbscan(xyz, DbscanParams(range_limits=(1.0,), eps=(0.3, 0.6), min_samples=min_samples))
    assert np.unique(banded[banded > 0]).tolist() == list(range(1, banded.max() + 1))


def test_layout_and_dtype_of_the_input_do_not_matter():
    xyz = np.random.default_rng(17).uniform(-1, 1, (300, 3)).astype(np.float32)
    labels, before = dbscan(xyz, 0.3, 4), xyz.copy()
    np.testing.assert_array_equal(dbscan(np.asfortranarray(xyz), 0.3, 4), labels)
    np.testing.assert_array_equal(dbscan(xyz.astype(np.float64), 0.3, 4), labels)
    wide = np.concatenate([xyz, xyz], axis=1)
    np.testing.assert_array_equal(distance_aware_dbscan(wide[:, :3]), distance_aware_dbscan(xyz))
    read_only = xyz.copy()
    read_only.flags.writeable = False
    np.testing.assert_array_equal(dbscan(read_only, 0.3, 4), labels)
    np.testing.assert_array_equal(xyz, before)


def test_million_equal_points_are_one_cluster():
    # Neighbour lists would need 10^12 entries.
    assert (dbscan(np.full((1_000_000, 3), 1.7, np.float32), 0.15, 10) == 1).all()


def test_dense_groups_within_eps_are_one_cluster():
    xyz = np.zeros((400_000, 3), np.float32)
    xyz[::2, 1] = 0.14
    assert (dbscan(xyz, 0.15, 10) == 1).all()


@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(1, 300),
    scale=st.sampled_from([0.3, 1.0, 4.0]),
    eps=st.sampled_from([0.1, 0.25, 0.5]),
    min_samples=st.integers(1, 12),
)
def test_both_implementations_equal_sklearn(seed, n, scale, eps, min_samples):
    rng = np.random.default_rng(seed)
    xyz = (rng.random((n, 3)) * scale).astype(np.float32)
    if seed % 2:
        xyz = np.round(xyz * 20) / np.float32(20)  # many distances equal eps
    expected = DBSCAN(eps=eps, min_samples=min_samples, algorithm="kd_tree").fit(xyz).labels_ + 1
    np.testing.assert_array_equal(dbscan_by_cells(xyz, eps, min_samples), expected)
    np.testing.assert_array_equal(dbscan_by_growing(xyz, eps, min_samples), expected)


def test_dbscan_by_growing_rejects_dense_points():
    assert dbscan_by_growing(np.zeros((100_000, 3), np.float32), 0.5, 10) is None


def test_forked_process_can_cluster():
    """A forked process lacks its parent's thread pool for the bands."""
    xyz = np.random.default_rng(0).uniform(-40, 40, (500, 3)).astype(np.float32)
    labels = distance_aware_dbscan(xyz)
    child = multiprocessing.get_context("fork").Process(target=assert_labels, args=(xyz, labels))
    child.start()
    child.join(30)
    if child.is_alive():
        child.kill()
    assert child.exitcode == 0


def assert_labels(xyz, labels):
    np.testing.assert_array_equal(distance_aware_dbscan(xyz), labels)
