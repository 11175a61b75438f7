"""Bounded work in clouds for which exact methods would compare all pairs of points."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from lidar_perception.clustering import dbscan_cells, thinning
from lidar_perception.clustering.dbscan import dbscan, distance_aware_dbscan
from lidar_perception.clustering.euclidean import cluster_euclidean
from lidar_perception.clustering.params import DbscanParams, EuclideanParams

REACH = 0.5


def make_shell(n, gap, seed=0):
    """Return points, half of them at x = 15 m and half on a hemisphere of radius (1 + gap) * REACH behind them."""
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(n // 2, 3))
    normal[:, 0] = np.abs(normal[:, 0]) + 0.2
    normal *= REACH * (1 + gap) / np.linalg.norm(normal, axis=1)[:, None]
    xyz = np.concatenate([rng.normal(0, 1e-7, (n - n // 2, 3)), normal])
    return (xyz + [14.999, 0, 0]).astype(np.float32)


METHODS = {
    "dbscan": lambda xyz: dbscan(xyz, REACH, 5),
    "bands": lambda xyz: distance_aware_dbscan(xyz, DbscanParams(eps=(REACH,) * 3, min_samples=5, join_bands=True)),
    "euclidean": lambda xyz: cluster_euclidean(
        xyz, EuclideanParams(threshold="fixed", distance=REACH, gamma=0.0), max_distances=-1
    ),
}
each_method = pytest.mark.parametrize("method", METHODS)


@pytest.fixture
def always_thin(monkeypatch):
    monkeypatch.setattr(thinning, "MIN_DISTANCES", 0)
    monkeypatch.setattr(thinning, "MAX_DISTANCES_PER_POINT", -1)


@each_method
def test_points_slightly_farther_than_eps_are_separate_clusters(method):
    assert METHODS[method](make_shell(3000, 0.001)).max() == 2
    assert METHODS[method](make_shell(3000, -0.001)).max() == 1


@each_method
@pytest.mark.parametrize("seed", range(3))
def test_thinning_extends_the_reach_within_its_tolerance(method, seed, always_thin):
    """Thinned clusters contain those of REACH and are contained in those of the longer reach."""
    rng = np.random.default_rng(seed)
    blobs = rng.uniform(-2.5, 2.5, (12, 3)) + [15, 0, 0]
    xyz = np.concatenate([blob + rng.normal(0, 0.05, (60, 3)) for blob in blobs])
    labels = METHODS[method](xyz.astype(np.float32))
    assert (labels > 0).all()
    distance = cdist(xyz, xyz)
    finest, coarsest = (connected_components(distance <= REACH * factor)[1] for factor in (1.0, 1.0 + thinning.SLACK))
    for coarser, finer in ((labels, finest), (coarsest, labels)):
        pairs = np.unique(np.column_stack([finer, coarser]), axis=0)
        assert len(pairs) == len(np.unique(finer))


def test_thinned_points_represent_neighbours_of_their_kind():
    rng = np.random.default_rng(0)
    xyz, kind = rng.random((4000, 3)), rng.integers(0, 2, 4000)
    reach = rng.choice([0.3, 3.0], 4000)
    representatives, group = thinning.thin_points(xyz, reach, kind)
    assert len(representatives) < 4000 and (group[representatives] == np.arange(len(representatives))).all()
    assert (kind[representatives[group]] == kind).all() and (reach[representatives[group]] == reach).all()
    distance = np.linalg.norm(xyz - xyz[representatives[group]], axis=1)
    assert (distance <= thinning.SLACK / 2 * reach).all()
    assert [len(x) for x in thinning.thin_points(np.zeros((0, 3)), 1.0)] == [0, 0]


@pytest.mark.parametrize("gap", [1e-3, 1e-5])
def test_cost_of_joining_cells_is_linear(gap, monkeypatch):
    """Count distances, exact and thinned; comparing all pairs would take 16 times as many."""
    monkeypatch.setattr(thinning, "MIN_DISTANCES", 0)
    monkeypatch.setattr(thinning, "MAX_DISTANCES_PER_POINT", 50)
    works, join_cells = [], dbscan_cells._join_cells

    def count_work(*arguments):
        parent, work = join_cells(*arguments)
        works[-1] += work
        return parent, work

    monkeypatch.setattr(dbscan_cells, "_join_cells", count_work)
    for count in (20_000, 80_000):
        works.append(0)
        METHODS["dbscan"](make_shell(count, gap))
    assert works[1] < 5 * max(works[0], 20_000 * 50), works
    assert works[1] < 100 * 80_000
