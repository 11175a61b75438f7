"""The tree: what all pairs say, from few of them, however the points lie."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from benchmark.plain_euclidean import euclidean as plain
from lidar_perception.clustering import euclidean as module
from lidar_perception.clustering.cells import around, cells_of, sample_of
from lidar_perception.clustering.dbscan import distance_aware_dbscan
from lidar_perception.clustering.euclidean import euclidean
from lidar_perception.clustering.params import DbscanParams, EuclideanParams
from lidar_perception.clustering.tree import (
    connected,
    crowded,
    nearest,
    nearest_leaders,
    touching,
    tree_of,
)

pytestmark = pytest.mark.no_cover  # others run these lines


def on_a_sphere(rng, n):
    normal = rng.normal(size=(n, 3))
    return normal / np.linalg.norm(normal, axis=1)[:, None] / 2


# Unit after unit of what makes neighbourhoods in a grid crowded: rng, n -> (n, 3).
ARRANGEMENTS = {
    "a cube": lambda rng, n: rng.random((n, 3)),
    "equal": lambda rng, n: np.full((n, 3), 0.3),
    "a line": lambda rng, n: np.linspace(0, 1, n)[:, None] * [1, 2, -1],
    "a sphere": on_a_sphere,
    "a sphere and its centre": lambda rng, n: np.concatenate(
        [on_a_sphere(rng, n // 2), rng.normal(0, 1e-5, (n - n // 2, 3))]),
    "two blobs out of reach": lambda rng, n: rng.random((n, 3)) * 0.1
    + (np.arange(n) % 2)[:, None] * [0, 0, 0.7],
    "a blob and dust": lambda rng, n: rng.random((n, 3)) * np.where(np.arange(n) % 2, 1e-3, 3)[
        :, None],
    "parallel walls": lambda rng, n: np.column_stack([np.arange(n) % 2 * 0.31, rng.random((n, 2))]),
    "a few indices": lambda rng, n: rng.integers(0, 3, (n, 3)) * 0.25,
}
each = pytest.mark.parametrize("arrange", ARRANGEMENTS.values(), ids=ARRANGEMENTS)


def points_of(arrange, count, seed=0):
    return arrange(np.random.default_rng(seed), count).astype(np.float32)


def lattice(data, most=60):
    """Points on a coarse lattice, where distances tie and indices coincide."""
    rows = data.draw(st.lists(st.tuples(*[st.integers(-4, 4)] * 3), min_size=1, max_size=most))
    return np.array(rows) * data.draw(st.sampled_from([0.125, 0.25]))


@given(st.data())
def test_every_search_of_the_tree_says_what_all_pairs_say(data):
    tree = tree_of(lattice(data))
    n = len(tree.points)
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    squared = cdist(tree.points, tree.points, "sqeuclidean")
    np.testing.assert_array_equal(
        nearest(tree)[0], np.where(np.eye(n, dtype=bool), np.inf, squared).min(axis=1))
    reach2 = rng.choice([0.0, 0.125, 0.25, 0.5], n) ** 2
    for enough in (1.0, 3.0, 7.5):
        np.testing.assert_array_equal(crowded(tree, reach2, enough)[0],
                                      (squared <= reach2[:, None]).sum(axis=1) >= enough)
    among = rng.random(n) < 0.7
    for gamma, linked in (
            (0.0, squared <= np.maximum(reach2[:, None], reach2)),
            (2.0, np.sqrt(squared) < 2.0 * (reach2[:, None] + reach2) / 2)):
        found = connected(tree, reach2, among, gamma, np.inf)[0]
        sets = connected_components(coo_matrix(linked & among & among[:, None]))[1]
        assert (found[~among] == -1).all() and (found[among] >= 0).all()
        np.testing.assert_array_equal(found[among, None] == found[among],
                                      sets[among, None] == sets[among])
    leader = nearest_leaders(tree, reach2, among)[0]
    for i in range(n):
        held = [(squared[i, j], *tree.points[j]) for j in np.flatnonzero(
            among & (squared[i] <= reach2))]
        assert (leader[i] >= 0) == (bool(held) and not among[i])
        if leader[i] >= 0:
            assert (squared[i, leader[i]], *tree.points[leader[i]]) == min(held)


@given(st.data())
def test_touching_connects_what_all_pairs_connect(data):
    tree = tree_of(lattice(data))
    n = len(tree.points)
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    label = np.unique(rng.integers(0, 12, n), return_inverse=True)[1]
    side = rng.integers(0, 2, label.max() + 1)[label]
    reach2 = data.draw(st.sampled_from([0.0, 0.125, 0.25, 0.5])) ** 2
    near = (cdist(tree.points, tree.points, "sqeuclidean") <= reach2) & (side[:, None] != side)
    i, j = np.nonzero(near)
    pairs = touching(tree, label, side, reach2, np.inf)[0]
    count = label.max() + 1
    assert len(pairs) < count

    def sets(a, b):
        return connected_components(coo_matrix((np.ones(len(a)), (a, b)), (count, count)))[1]
    np.testing.assert_array_equal(sets(*pairs.T), sets(label[i], label[j]))


SETTINGS = [EuclideanParams(), EuclideanParams(threshold="global"),
            EuclideanParams(threshold="fixed", distance=0.1),
            EuclideanParams(alpha=0.5, beta=2.0, gamma=0.2, min_size=1)]


@each
@pytest.mark.parametrize("params", SETTINGS, ids=range(4))
@pytest.mark.parametrize("patience", [-1, 2000])
def test_by_grid_and_by_tree_euclidean_is_the_same(arrange, params, patience):
    """And the plain reading, which has no fixed threshold. A patience of -1 leaves all to the
    tree."""
    xyz = points_of(arrange, 700)
    expected = euclidean(xyz, params, 10**9) if params.threshold == "fixed" else plain(xyz, params)
    np.testing.assert_array_equal(euclidean(xyz, params, patience), expected)


def works(xyz):
    """Distances that each search of the tree computes."""
    tree = tree_of(xyz)
    n = len(xyz)
    reach2, leads = np.full(n, 0.3**2), np.ones(n, bool)
    tiny = np.full(n, 1e-6**2)
    side = np.arange(n) % 2
    return {"nearest": nearest(tree)[1], "crowded": crowded(tree, reach2, 10.0)[1],
            "crowded, no reach": crowded(tree, tiny, 10.0)[1],
            "connected": connected(tree, reach2, leads, 0.0, np.inf)[1],
            "connected, no reach": connected(tree, tiny, leads, 0.0, np.inf)[1],
            "leaders": nearest_leaders(tree, reach2, side == 0)[1],
            "touching": touching(tree, side, side, 0.3**2, np.inf)[1],
            "touching, no reach": touching(tree, side, side, 0.0, np.inf)[1]}


@each
def test_the_work_of_the_tree_grows_as_n_log_n(arrange):
    """Counted in distances, four times the points take less than six times the work (n log n: 4.6)
    and never more than a few boxes a point."""
    few, many = 4000, 16_000
    small, large = works(points_of(arrange, few)), works(points_of(arrange, many))
    for name, work in large.items():
        assert work < 6 * max(small[name], 20 * few), (name, small[name], work)
        assert work < 40 * many * np.log2(many), (name, work)


@each
def test_the_work_of_local_thresholds_has_a_bound(arrange):
    for count in (2000, 8000):
        cells = cells_of(points_of(arrange, count), 0.5)
        sample = sample_of(cells, 27 * 50 * count)  # 50 of each cell at most
        kept = np.diff(sample.start)
        assert kept.min() >= 1 and (kept <= np.diff(cells.start)).all()
        np.testing.assert_allclose(kept * sample.weight, np.diff(cells.start))
        near = [sum(kept[low:high].sum() for low, high in zip(
            cells.low[a, :cells.ranges[a]], cells.high[a, :cells.ranges[a]]))
            for a in range(len(kept))]
        assert np.diff(cells.start) @ near <= 27 * 50 * count


@pytest.mark.parametrize("arrange", [ARRANGEMENTS[name] for name in (
    "a cube", "equal", "a line", "a sphere", "two blobs out of reach", "a few indices")])
def test_a_sample_gives_nearly_the_same_means_whatever_the_order(arrange):
    xyz = points_of(arrange, 3000)
    cells = cells_of(xyz, 0.5)
    exact, sampled = np.empty(3000), np.empty(3000)
    radii2 = np.full(3000, 0.25)
    exact[cells.order] = module._means(cells, radii2)
    part = sample_of(cells, int(around(cells) * 3000 / 4))
    sampled[cells.order] = module._means_of_sample(cells, part, radii2)
    dense = exact > 0
    error = np.abs(sampled[dense] / exact[dense] - 1)
    assert len(error) == 0 or np.median(error) < 0.05
    order = np.random.default_rng(1).permutation(3000)
    again = cells_of(xyz[order], 0.5)
    other = np.empty(3000)
    other[order[again.order]] = module._means_of_sample(
        again, sample_of(again, int(around(again) * 3000 / 4)), radii2)
    np.testing.assert_allclose(other, sampled, rtol=1e-9, atol=1e-12)


def test_a_dense_wall_at_a_limit_is_joined_with_few_distances():
    """Wherever it is cut: its halves become one, whether they are near or only touch."""
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.normal(15, 0.01, 4000), rng.uniform(-0.7, 0.7, 4000),
                            rng.uniform(-1.7, 0.7, 4000)]).astype(np.float32)
    params = DbscanParams(eps=(0.15, 0.3, 0.5), join_bands=True)
    assert distance_aware_dbscan(wall, replace(params, join_bands=False)).max() == 2
    assert distance_aware_dbscan(wall, params).max() == 1
    tree = tree_of(wall)
    side = (np.hypot(*tree.points[:, :2].T) >= 15).astype(np.int64)
    pairs, work = touching(tree, side, side, 0.15**2, np.inf)
    assert len(pairs) == 1 and work < 100
