"""Growing by curvature equals a NumPy reference and separates a bush from the wall behind it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lidar_perception.clustering.curvature import find_consistent_points
from lidar_perception.clustering.euclidean import MAX_WORK, cluster_euclidean
from lidar_perception.clustering.params import EuclideanParams


def make_wall_and_bush(seed=0):
    """Return a smooth wall (2000, 3), and a bush (3000, 3) that touches its end."""
    rng = np.random.default_rng(seed)
    wall = np.stack([np.full(2000, 10.0), *rng.uniform([[-2], [0]], [[0], [2]], (2, 2000))], axis=1)
    bush = rng.uniform([9.5, -0.05, 0], [10.5, 1.5, 2], (3000, 3))
    return wall.astype(np.float32), bush.astype(np.float32)


def find_consistent_points_slowly(xyz, radius, limit):
    xyz = np.float64(xyz)
    near = np.linalg.norm(xyz[:, None] - xyz[None], axis=2) <= radius
    variation = np.array(
        [
            np.linalg.eigvalsh(np.cov(xyz[own].T, bias=True))[0] / max(np.trace(np.cov(xyz[own].T, bias=True)), 1e-30)
            for own in near
        ]
    )
    means = np.array([variation[own].mean() for own in near])
    return np.abs(variation - means) <= limit


def test_consistent_points_equal_numpy_reference():
    xyz = np.concatenate(make_wall_and_bush())[::10]
    radii = np.full(len(xyz), 0.5)
    result = find_consistent_points(xyz, radii, 0.02, MAX_WORK)
    assert 0.1 < result.mean() < 0.9
    np.testing.assert_array_equal(result, find_consistent_points_slowly(xyz, 0.5, 0.02))
    assert (find_consistent_points(xyz, radii, 0.02, 1000) == result).mean() > 0.5  # estimated from 1000 points


@pytest.mark.parametrize("max_distances", [2**15, 0], ids=["grid", "tree"])
def test_growing_stops_where_the_curvature_changes(max_distances):
    wall, bush = make_wall_and_bush()
    xyz, params = np.concatenate([wall, bush]), EuclideanParams(threshold="fixed", distance=0.25, gamma=0.0)
    assert len(np.unique(cluster_euclidean(xyz, params, max_distances))) == 1
    labels = cluster_euclidean(xyz, replace(params, curvature=0.02), max_distances)
    of_wall, of_bush = np.bincount(labels[:2000]).argmax(), np.bincount(labels[2000:]).argmax()
    assert of_wall != of_bush
    assert (labels[:2000] == of_wall).mean() > 0.7 and (labels[2000:] == of_bush).mean() > 0.9


def test_smooth_surface_is_one_region():
    assert find_consistent_points(make_wall_and_bush()[0], np.full(2000, 0.5), 1e-6, MAX_WORK).all()
    assert find_consistent_points(np.ones((5, 3), np.float32), np.ones(5), 0.0, MAX_WORK).all()
