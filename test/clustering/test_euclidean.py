"""Adaptive Euclidean clustering (paper C) equals a plain SciPy implementation of the equations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmark.plain_euclidean import cluster_euclidean as plain_euclidean
from lidar_perception.clustering.euclidean import cluster_euclidean
from lidar_perception.clustering.params import EuclideanParams

pytestmark = pytest.mark.no_cover  # covered by other tests

LOCAL = EuclideanParams()
SETTINGS = [
    LOCAL,
    replace(LOCAL, gamma=0.0),
    replace(LOCAL, threshold="global", gamma=0.0),
    replace(LOCAL, threshold="global", min_size=3),
    replace(LOCAL, beta=0.0, min_size=1),
]
SETTING_NAMES = ["local", "local, not merged", "global, not merged", "global", "no MinPts"]


def make_blobs(seed, centres, count=200, spread=0.15):
    rng = np.random.default_rng(seed)
    centres = np.asarray(centres, float)
    points = centres[:, None] + rng.normal(0, spread, (len(centres), count, 3))
    return points.reshape(-1, 3).astype(np.float32)


def make_scene(seed, count=3000):
    """Return a cloud of dense and sparse clusters, a line and single points."""
    rng = np.random.default_rng(seed)
    return np.concatenate(
        [
            make_blobs(seed, rng.uniform(-20, 20, (8, 3)) * [1, 1, 0.1], count // 10, 0.2),
            make_blobs(seed + 1, rng.uniform(-40, 40, (5, 3)) * [1, 1, 0.1], 12, 0.4),
            np.stack([np.linspace(-10, 10, 100), np.full(100, 5.0), np.zeros(100)], axis=1),
            rng.uniform(-30, 30, (100, 3)),
        ]
    ).astype(np.float32)


def is_same_partition(a, b):
    pairs = np.unique(np.stack([a, b], axis=1), axis=0)
    return len(pairs) == len(np.unique(a)) == len(np.unique(b)) and np.array_equal(a == 0, b == 0)


DEGENERATE = {
    "empty": np.zeros((0, 3)),
    "one point": np.ones((1, 3)),
    "two points": np.array([[0, 0, 0], [1, 0, 0]]),
    "all equal": np.full((500, 3), 3.3),
    "collinear": np.arange(200)[:, None] * [0.1, 0.2, 0.0],
    "a plane of equal distances": np.stack(np.meshgrid(*[np.arange(20) * 0.25] * 2, [0]), axis=-1).reshape(-1, 3),
    "coincident clusters": np.repeat(np.array([[0, 0, 0], [5, 0, 0]]), 50, axis=0),
    "far apart": np.array([[0, 0, 0]] * 12 + [[1e6, 0, 0]] * 12 + [[-1e6, 1e6, 100]]),
    "one dense, one far": np.concatenate([make_blobs(0, [[0, 0, 0]], 300, 0.01), [[3000, 0, 0], [3003, 0, 0]]]),
}


@pytest.mark.parametrize("params", SETTINGS, ids=SETTING_NAMES)
@pytest.mark.parametrize("xyz", DEGENERATE.values(), ids=DEGENERATE)
def test_degenerate_clouds_equal_the_plain_implementation(xyz, params):
    xyz = np.asarray(xyz, np.float32)
    labels = cluster_euclidean(xyz, params)
    assert labels.dtype == np.int32 and labels.shape == (len(xyz),)
    np.testing.assert_array_equal(labels, plain_euclidean(xyz, params))


@pytest.mark.parametrize("params", SETTINGS, ids=SETTING_NAMES)
@pytest.mark.parametrize("seed", range(3))
def test_scenes_equal_the_plain_implementation(seed, params):
    labels = cluster_euclidean(make_scene(seed), params)
    np.testing.assert_array_equal(labels, plain_euclidean(make_scene(seed), params))
    # Check that the comparison is not trivial.
    assert labels.max() > 3 and ((labels == 0).any() or params.beta == 0)


@given(st.data())
def test_lattice_clouds_equal_the_plain_implementation(data):
    """On a coarse lattice many distances are equal or equal to a threshold."""
    count = data.draw(st.integers(1, 60))
    step = data.draw(st.sampled_from([0.05, 0.125, 0.3, 2.0]))
    rows = data.draw(st.lists(st.tuples(*[st.integers(-6, 6)] * 3), min_size=count, max_size=count))
    params = EuclideanParams(
        threshold=data.draw(st.sampled_from(["global", "local"])),
        alpha=data.draw(st.sampled_from([0.5, 1.0, 1.2, 3.0])),
        beta=data.draw(st.sampled_from([0.0, 0.5, 1.5])),
        gamma=data.draw(st.sampled_from([0.0, 0.8, 2.0])),
        radius=data.draw(st.sampled_from([0.125, 0.5])),
        min_size=data.draw(st.integers(1, 6)),
    )
    xyz = (np.array(rows) * step).astype(np.float32)
    np.testing.assert_array_equal(cluster_euclidean(xyz, params), plain_euclidean(xyz, params))


@pytest.mark.parametrize("threshold", ["local", "global"])
def test_real_scan_equals_the_plain_implementation(threshold, data):
    from lidar_perception.ground.params import GroundParams
    from lidar_perception.ground.segment import segment_ground
    from lidar_perception.types import PointCloud

    path = next((data / "kitti_object").rglob("velodyne/*.bin"))
    points = np.fromfile(path, np.float32).reshape(-1, 4)
    frame = PointCloud(xyz=np.ascontiguousarray(points[:, :3]), intensity=np.ascontiguousarray(points[:, 3]))
    ground = segment_ground(frame, GroundParams(method="cloth"))
    xyz = frame.xyz[~ground][::3]
    params = replace(LOCAL, threshold=threshold, gamma=0.0 if threshold == "global" else 0.8)
    np.testing.assert_array_equal(cluster_euclidean(xyz, params), plain_euclidean(xyz, params))


def test_far_outliers_do_not_change_local_thresholds():
    xyz, far = make_scene(2), np.float32([[5e4, 0, 0], [0, -9e4, 10], [1e5, 1e5, 1e5]])
    # MinPts = beta ln N counts all points (Eq. 7); three more do not reach the next integer here.
    assert np.ceil(0.5 * np.log(len(xyz))) == np.ceil(0.5 * np.log(len(xyz) + 3))
    labels = cluster_euclidean(np.concatenate([xyz, far]), LOCAL)
    np.testing.assert_array_equal(labels[:-3], cluster_euclidean(xyz, LOCAL))
    assert not labels[-3:].any()


def test_min_size_only_drops_small_clusters():
    xyz, base = make_scene(1), replace(LOCAL, gamma=0.0)
    unfiltered = cluster_euclidean(xyz, replace(base, min_size=1))
    size = np.bincount(unfiltered)[unfiltered]
    for min_size in (2, 10, 40):
        labels = cluster_euclidean(xyz, replace(base, min_size=min_size))
        assert is_same_partition(labels, np.where(size >= min_size, unfiltered, 0))


def test_gamma_merges_clusters_nearer_than_their_diameters():
    """The boxes have diagonal 2: centres 1.5 apart are nearer than 0.8 * 2, 1.7 apart are not."""

    def make_walls(distance):
        line = np.linspace(-1, 1, 60)
        one = np.stack([np.zeros(60), line, np.zeros(60)], axis=1)
        return np.concatenate([one, one + [distance, 0, 0]]).astype(np.float32)

    params = replace(LOCAL, radius=0.3)
    assert cluster_euclidean(make_walls(1.5), params).max() == 1
    assert cluster_euclidean(make_walls(1.7), params).max() == 2
    assert cluster_euclidean(make_walls(1.5), replace(params, gamma=0.0)).max() == 2


def test_local_threshold_adapts_to_the_density():
    """Eq. 11, the default, finds a wall with points 2 cm apart and one with points 0.4 m apart, as on a distant
    car. A single threshold finds only the dense wall."""

    def wall(x, step):
        y, z = np.meshgrid(np.arange(0, 2.01, step), np.arange(0, 1.61, step))
        return np.stack([np.full(y.size, x), y.ravel(), z.ravel()], axis=1)

    xyz = np.concatenate([wall(0, 0.02), wall(40, 0.4)]).astype(np.float32)
    labels = cluster_euclidean(xyz, LOCAL)
    assert labels.max() == 2 and (labels == 0).sum() < 5  # corners have few neighbours
    one = cluster_euclidean(xyz, replace(LOCAL, threshold="global"))
    assert one.max() == 1 and not one[-30:].any()
