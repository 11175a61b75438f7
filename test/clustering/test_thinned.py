"""Arrangements that make every exact method look at all pairs: their work has a bound too."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from lidar_perception.clustering import dense, thinned
from lidar_perception.clustering.dbscan import dbscan, distance_aware_dbscan
from lidar_perception.clustering.euclidean import euclidean
from lidar_perception.clustering.params import DbscanParams, EuclideanParams

REACH = 0.5


def shell(n, gap, seed=0):
    """Half of the points on one place at x = 15 m, the others on a half sphere around it, a share
    `gap` of REACH out of reach, further out."""
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(n // 2, 3))
    normal[:, 0] = np.abs(normal[:, 0]) + 0.2
    normal *= REACH * (1 + gap) / np.linalg.norm(normal, axis=1)[:, None]
    xyz = np.concatenate([rng.normal(0, 1e-7, (n - n // 2, 3)), normal])
    return (xyz + [14.999, 0, 0]).astype(np.float32)


METHODS = {
    "dbscan": lambda xyz: dbscan(xyz, REACH, 5),
    "bands": lambda xyz: distance_aware_dbscan(xyz, DbscanParams(
        eps=(REACH,) * 3, min_samples=5, join_bands=True)),
    "euclidean": lambda xyz: euclidean(xyz, EuclideanParams(threshold="fixed", distance=REACH,
                                                            gamma=0.0), patience=-1),
}
each_method = pytest.mark.parametrize("method", METHODS)


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(thinned, "ENOUGH", 0)
    monkeypatch.setattr(thinned, "PATIENCE", -1)


@each_method
def test_with_patience_a_hair_out_of_reach_is_another_cluster(method):
    assert METHODS[method](shell(3000, 0.001)).max() == 2
    assert METHODS[method](shell(3000, -0.001)).max() == 1


@each_method
@pytest.mark.parametrize("seed", range(3))
def test_without_patience_a_longer_reach_connects_no_less(method, seed, impatient):
    """What it connects is between what the reach and the longer reach connect."""
    rng = np.random.default_rng(seed)
    blobs = rng.uniform(-2.5, 2.5, (12, 3)) + [15, 0, 0]
    xyz = np.concatenate([blob + rng.normal(0, 0.05, (60, 3)) for blob in blobs])
    labels = METHODS[method](xyz.astype(np.float32))
    assert (labels > 0).all()
    distance = cdist(xyz, xyz)
    least, most = (connected_components(distance <= REACH * longer)[1]
                   for longer in (1.0, 1.0 + thinned.SLACK))
    for sets, finer in ((labels, least), (most, labels)):
        pairs = np.unique(np.column_stack([finer, sets]), axis=0)
        assert len(pairs) == len(np.unique(finer))


def test_one_of_each_cube_stands_for_the_others():
    rng = np.random.default_rng(0)
    xyz, kind = rng.random((4000, 3)), rng.integers(0, 2, 4000)
    reach = rng.choice([0.3, 3.0], 4000)
    kept, group = thinned.thinned(xyz, reach, kind)
    assert len(kept) < 4000 and (group[kept] == np.arange(len(kept))).all()
    assert (kind[kept[group]] == kind).all() and (reach[kept[group]] == reach).all()
    away = np.linalg.norm(xyz - xyz[kept[group]], axis=1)
    assert (away <= thinned.SLACK / 2 * reach).all()
    assert [len(x) for x in thinned.thinned(np.zeros((0, 3)), 1.0)] == [0, 0]


@pytest.mark.parametrize("gap", [1e-3, 1e-5])
def test_the_work_of_joining_grows_no_faster_than_the_points(gap, monkeypatch):
    """Counted in distances, exact and thinned together; all pairs would be 16 times as many."""
    monkeypatch.setattr(thinned, "ENOUGH", 0)
    monkeypatch.setattr(thinned, "PATIENCE", 50)
    works, joined = [], dense._joined

    def counted(*arguments):
        parent, work = joined(*arguments)
        works[-1] += work
        return parent, work
    monkeypatch.setattr(dense, "_joined", counted)
    for count in (20_000, 80_000):
        works.append(0)
        METHODS["dbscan"](shell(count, gap))
    assert works[1] < 5 * max(works[0], 20_000 * 50), works
    assert works[1] < 100 * 80_000
