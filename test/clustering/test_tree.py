"""The k-d tree equals a comparison of all pairs, and its work is bounded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from benchmark.plain_euclidean import cluster_euclidean as plain_euclidean
from lidar_perception.clustering import euclidean
from lidar_perception.clustering.cells import compute_mean_neighbourhood_size, sample_cells, sort_into_cells
from lidar_perception.clustering.dbscan import distance_aware_dbscan
from lidar_perception.clustering.euclidean import cluster_euclidean
from lidar_perception.clustering.params import DbscanParams, EuclideanParams
from lidar_perception.clustering.tree import (
    build_tree,
    find_components,
    find_core_points_in_tree,
    find_nearest_core_points,
    find_nearest_distances,
    find_touching_labels,
)

pytestmark = pytest.mark.no_cover  # covered by other tests


def draw_sphere(rng, n):
    normal = rng.normal(size=(n, 3))
    return normal / np.linalg.norm(normal, axis=1)[:, None] / 2


# Clouds with many points in one neighbourhood of a grid: rng, n -> (n, 3).
ARRANGEMENTS = {
    "a cube": lambda rng, n: rng.random((n, 3)),
    "equal": lambda rng, n: np.full((n, 3), 0.3),
    "a line": lambda rng, n: np.linspace(0, 1, n)[:, None] * [1, 2, -1],
    "a sphere": draw_sphere,
    "a sphere and its centre": lambda rng, n: np.concatenate(
        [draw_sphere(rng, n // 2), rng.normal(0, 1e-5, (n - n // 2, 3))]
    ),
    "two blobs out of reach": lambda rng, n: rng.random((n, 3)) * 0.1 + (np.arange(n) % 2)[:, None] * [0, 0, 0.7],
    "a blob and dust": lambda rng, n: rng.random((n, 3)) * np.where(np.arange(n) % 2, 1e-3, 3)[:, None],
    "parallel walls": lambda rng, n: np.column_stack([np.arange(n) % 2 * 0.31, rng.random((n, 2))]),
    "a few indices": lambda rng, n: rng.integers(0, 3, (n, 3)) * 0.25,
}
each_arrangement = pytest.mark.parametrize("arrange", ARRANGEMENTS.values(), ids=ARRANGEMENTS)


def make_points(arrange, count, seed=0):
    return arrange(np.random.default_rng(seed), count).astype(np.float32)


def draw_lattice(data):
    """Draw points on a coarse lattice with many equal distances and coincident points."""
    rows = data.draw(st.lists(st.tuples(*[st.integers(-4, 4)] * 3), min_size=1, max_size=60))
    return np.array(rows) * data.draw(st.sampled_from([0.125, 0.25]))


@given(st.data())
def test_tree_searches_equal_brute_force(data):
    tree = build_tree(draw_lattice(data))
    n = len(tree.points)
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    squared = cdist(tree.points, tree.points, "sqeuclidean")
    others = np.where(np.eye(n, dtype=bool), np.inf, squared)
    np.testing.assert_array_equal(find_nearest_distances(tree)[0], others.min(axis=1))
    reach2 = rng.choice([0.0, 0.125, 0.25, 0.5], n) ** 2
    for min_points in (1.0, 3.0, 7.5):
        np.testing.assert_array_equal(
            find_core_points_in_tree(tree, reach2, min_points)[0],
            (squared <= reach2[:, None]).sum(axis=1) >= min_points,
        )
    selected = rng.random(n) < 0.7
    for gamma, linked in (
        (0.0, squared <= np.maximum(reach2[:, None], reach2)),
        (2.0, np.sqrt(squared) < 2.0 * (reach2[:, None] + reach2) / 2),
    ):
        result = find_components(tree, reach2, selected, gamma, np.inf)[0]
        sets = connected_components(coo_matrix(linked & selected & selected[:, None]))[1]
        assert (result[~selected] == -1).all() and (result[selected] >= 0).all()
        np.testing.assert_array_equal(
            result[selected, None] == result[selected], sets[selected, None] == sets[selected]
        )
    nearest = find_nearest_core_points(tree, reach2, selected)[0]
    for i in range(n):
        within = [(squared[i, j], *tree.points[j]) for j in np.flatnonzero(selected & (squared[i] <= reach2))]
        assert (nearest[i] >= 0) == (bool(within) and not selected[i])
        if nearest[i] >= 0:
            assert (squared[i, nearest[i]], *tree.points[nearest[i]]) == min(within)


@given(st.data())
def test_touching_labels_equal_brute_force(data):
    tree = build_tree(draw_lattice(data))
    n = len(tree.points)
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    label = np.unique(rng.integers(0, 12, n), return_inverse=True)[1]
    side = rng.integers(0, 2, label.max() + 1)[label]
    reach2 = data.draw(st.sampled_from([0.0, 0.125, 0.25, 0.5])) ** 2
    near = (cdist(tree.points, tree.points, "sqeuclidean") <= reach2) & (side[:, None] != side)
    i, j = np.nonzero(near)
    pairs = find_touching_labels(tree, label, side, reach2, np.inf)[0]
    count = label.max() + 1
    assert len(pairs) < count

    def find_components(a, b):
        return connected_components(coo_matrix((np.ones(len(a)), (a, b)), (count, count)))[1]

    np.testing.assert_array_equal(find_components(*pairs.T), find_components(label[i], label[j]))


SETTINGS = [
    EuclideanParams(),
    EuclideanParams(threshold="global"),
    EuclideanParams(threshold="fixed", distance=0.1),
    EuclideanParams(alpha=0.5, beta=2.0, gamma=0.2, min_size=1),
]


@each_arrangement
@pytest.mark.parametrize("params", SETTINGS, ids=range(4))
@pytest.mark.parametrize("max_distances", [-1, 2000])
def test_grid_and_tree_give_the_same_clusters(arrange, params, max_distances):
    """max_distances=-1 uses only the tree. The plain implementation does not support a fixed threshold."""
    xyz = make_points(arrange, 700)
    expected = cluster_euclidean(xyz, params, 10**9) if params.threshold == "fixed" else plain_euclidean(xyz, params)
    np.testing.assert_array_equal(cluster_euclidean(xyz, params, max_distances), expected)


def count_work(xyz):
    """Return the number of distances that each search of the tree computes."""
    tree = build_tree(xyz)
    n = len(xyz)
    reach2, selected = np.full(n, 0.3**2), np.ones(n, bool)
    tiny = np.full(n, 1e-6**2)
    side = np.arange(n) % 2
    return {
        "nearest": find_nearest_distances(tree)[1],
        "core points": find_core_points_in_tree(tree, reach2, 10.0)[1],
        "core points, no reach": find_core_points_in_tree(tree, tiny, 10.0)[1],
        "components": find_components(tree, reach2, selected, 0.0, np.inf)[1],
        "components, no reach": find_components(tree, tiny, selected, 0.0, np.inf)[1],
        "nearest core points": find_nearest_core_points(tree, reach2, side == 0)[1],
        "touching": find_touching_labels(tree, side, side, 0.3**2, np.inf)[1],
        "touching, no reach": find_touching_labels(tree, side, side, 0.0, np.inf)[1],
    }


@each_arrangement
def test_cost_of_the_tree_is_n_log_n(arrange):
    """Four times the points take less than six times the distances (n log n: 4.6)."""
    few, many = 4000, 16_000
    small, large = (count_work(make_points(arrange, count)) for count in (few, many))
    for name, work in large.items():
        assert work < 6 * max(small[name], 20 * few), (name, small[name], work)
        assert work < 40 * many * np.log2(many), (name, work)


@each_arrangement
def test_sampling_bounds_the_cost_of_local_thresholds(arrange):
    for count in (2000, 8000):
        cells = sort_into_cells(make_points(arrange, count), 0.5)
        sample = sample_cells(cells, 27 * 50 * count)  # at most 50 points per cell
        sample_sizes = np.diff(sample.start)
        assert sample_sizes.min() >= 1 and (sample_sizes <= np.diff(cells.start)).all()
        np.testing.assert_allclose(sample_sizes * sample.weight, np.diff(cells.start))
        near = [
            sum(
                sample_sizes[low:high].sum()
                for low, high in zip(cells.low[a, : cells.ranges[a]], cells.high[a, : cells.ranges[a]])
            )
            for a in range(len(sample_sizes))
        ]
        assert np.diff(cells.start) @ near <= 27 * 50 * count


@pytest.mark.parametrize(
    "arrange",
    [
        ARRANGEMENTS[name]
        for name in ("a cube", "equal", "a line", "a sphere", "two blobs out of reach", "a few indices")
    ],
)
def test_sampled_means_are_accurate_in_any_order_of_points(arrange):
    xyz = make_points(arrange, 3000)
    cells = sort_into_cells(xyz, 0.5)
    exact, sampled = np.empty(3000), np.empty(3000)
    radii2 = np.full(3000, 0.25)
    exact[cells.order] = euclidean._compute_mean_distances(cells, radii2)
    sample = sample_cells(cells, int(compute_mean_neighbourhood_size(cells) * 3000 / 4))
    sampled[cells.order] = euclidean._estimate_mean_distances(cells, sample, radii2)
    dense = exact > 0
    error = np.abs(sampled[dense] / exact[dense] - 1)
    assert len(error) == 0 or np.median(error) < 0.05
    order = np.random.default_rng(1).permutation(3000)
    shuffled = sort_into_cells(xyz[order], 0.5)
    sample = sample_cells(shuffled, int(compute_mean_neighbourhood_size(shuffled) * 3000 / 4))
    other = np.empty(3000)
    other[order[shuffled.order]] = euclidean._estimate_mean_distances(shuffled, sample, radii2)
    np.testing.assert_allclose(other, sampled, rtol=1e-9, atol=1e-12)


def test_cost_of_joining_a_dense_wall_is_low():
    rng = np.random.default_rng(0)
    wall = np.column_stack(
        [rng.normal(15, 0.01, 4000), rng.uniform(-0.7, 0.7, 4000), rng.uniform(-1.7, 0.7, 4000)]
    ).astype(np.float32)
    params = DbscanParams(eps=(0.15, 0.3, 0.5), join_bands=True)
    assert distance_aware_dbscan(wall, replace(params, join_bands=False)).max() == 2
    assert distance_aware_dbscan(wall, params).max() == 1
    tree = build_tree(wall)
    side = (np.hypot(*tree.points[:, :2].T) >= 15).astype(np.int64)
    pairs, work = find_touching_labels(tree, side, side, 0.15**2, np.inf)
    assert len(pairs) == 1 and work < 100
