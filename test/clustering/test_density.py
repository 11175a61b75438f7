"""Density of a cloud, and clustering parameters that adapt to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from samples import DATA, needs_data

from lidar_perception.candidates.configurations import BEST
from lidar_perception.classes import DETECTED
from lidar_perception.clustering import density
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.clustering.density import (
    MAX_WIDENING,
    MIN_CLUSTER_POINTS,
    adapt_to_density,
    compute_radii,
    measure_density,
)
from lidar_perception.clustering.euclidean import cluster_euclidean
from lidar_perception.clustering.params import FULL_DENSITY, ClusteringParams, EuclideanParams
from lidar_perception.data.open import open_recording
from lidar_perception.detectors.pointnet.config import PointNetConfig
from lidar_perception.detectors.pointpillars.params import EXPERT_CLUSTERING
from lidar_perception.geometry import points_in_box
from lidar_perception.simulation.drive import simulate_scan
from lidar_perception.simulation.sensor import HDL64E

ADAPTIVE = (PointNetConfig().clustering, EXPERT_CLUSTERING, BEST.clustering)


@pytest.fixture(scope="module")
def scan():
    return simulate_scan(4, 0, HDL64E)


def make_scan(elevation_step, azimuth_step, rng):
    """Return a scan of surfaces 2 to 60 m away, with the given angular steps in degrees."""
    elevation, azimuth = np.radians(
        np.meshgrid(np.arange(-25.0, 5.0, elevation_step), np.arange(-180, 180, azimuth_step))
    )
    distance = rng.uniform(2, 60, elevation.shape)
    return (
        np.stack(
            [
                distance * np.cos(elevation) * np.cos(azimuth),
                distance * np.cos(elevation) * np.sin(azimuth),
                distance * np.sin(elevation),
            ],
            axis=-1,
        )
        .reshape(-1, 3)
        .astype(np.float32)
    )


@pytest.mark.parametrize(
    "elevation_step, azimuth_step", [(0.4, 0.17), (0.5, 0.5), (1.33, 0.33), (2.0, 0.2), (2.0, 2.0)]
)
def test_density_matches_angular_resolution(elevation_step, azimuth_step):
    # Each beam has 1 / azimuth_step returns per degree of azimuth, at every elevation.
    slant = np.cos(np.radians(np.arange(-25.0, 5.0, elevation_step))).mean()
    expected = 1 / (elevation_step * azimuth_step * slant)
    # Cells at the border of the view, or between two beams, are half filled, which lowers the density.
    result = measure_density(make_scan(elevation_step, azimuth_step, np.random.default_rng(3)))
    assert result == pytest.approx(expected, rel=0.12, abs=0.3)


@pytest.fixture(scope="module")
def full_density(scan):
    """Density of the scan without sampling."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(density, "MAX_SAMPLED", len(scan.frame.xyz))
        return measure_density(scan.frame.xyz)


@settings(max_examples=10, database=None)
@given(st.floats(0.05, 1.0), st.integers(0, 99))
def test_density_falls_when_points_are_removed(scan, full_density, share, seed):
    xyz = scan.frame.xyz
    is_kept = np.random.default_rng(seed).random(len(xyz)) < share
    assert measure_density(xyz[is_kept]) == pytest.approx(share * full_density, rel=0.08)


def test_cropping_and_scaling_keep_the_density(scan):
    xyz = scan.frame.xyz
    assert measure_density(xyz[xyz[:, 0] > 5]) == pytest.approx(measure_density(xyz), rel=0.1)
    assert measure_density(xyz * np.float32(0.1)) == pytest.approx(measure_density(xyz), rel=1e-3)


def test_unknown_or_full_density_changes_no_parameters():
    lonely = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    unusable = np.array([[0, 0, 0], [np.nan, 1, 1], [np.inf, 0, 0]], np.float32)
    for xyz in (np.zeros((0, 3), np.float32), lonely, unusable):
        assert measure_density(xyz) == 0.0
    for params in ADAPTIVE:
        for known in (0.0, FULL_DENSITY, 15.0, 1e9):
            assert adapt_to_density(params, known) is params
    assert adapt_to_density(ClusteringParams(), 0.1) == ClusteringParams()


@given(st.floats(1e-9, FULL_DENSITY), st.floats(1e-9, FULL_DENSITY))
def test_sparser_clouds_get_wider_radii_and_smaller_sizes(a, b):
    sparse, dense = sorted([a, b])
    for params in ADAPTIVE:
        wide, narrow = adapt_to_density(params, sparse), adapt_to_density(params, dense)
        for one, other, given_ in zip(wide.dbscan.eps, narrow.dbscan.eps, params.dbscan.eps):
            assert given_ <= other <= one <= MAX_WIDENING * given_ * (1 + 1e-9)
        assert wide.euclidean.radius >= narrow.euclidean.radius >= params.euclidean.radius
        assert wide.euclidean.beta <= narrow.euclidean.beta <= params.euclidean.beta
        assert MIN_CLUSTER_POINTS - 1 <= wide.dbscan.min_samples <= narrow.dbscan.min_samples
        assert MIN_CLUSTER_POINTS <= wide.euclidean.min_size <= narrow.euclidean.min_size


def test_radii_grow_with_the_range():
    ranges = np.array([0.1, 5.0, 10.0, 20.0, 40.0, 80.0])
    xyz = np.column_stack([ranges, np.zeros((6, 2))]).astype(np.float32)
    result = compute_radii(xyz, 1.5, 0.5, 1.3)
    assert result.min() == 0.5 and result.max() == 1.3 and (np.diff(result) >= 0).all()
    unlimited = compute_radii(xyz, 1.5, 0.0, 99.0)
    assert compute_radii(xyz, 6.0, 0.0, 99.0) == pytest.approx(unlimited / 2)


def test_points_with_different_radii_cluster_as_if_separate():
    rng = np.random.default_rng(8)
    params = EuclideanParams(gamma=0.0, beta=0.0, min_size=3)
    near, far = (rng.uniform(-6, 6, (600, 3)).astype(np.float32) + [x, 0, 0] for x in (0, 500))
    together = cluster_euclidean(np.concatenate([near, far]), params, radii=np.repeat([0.5, 1.2], 600))
    one, other = (
        cluster_euclidean(xyz.astype(np.float32), replace(params, radius=radius))
        for xyz, radius in ((near, 0.5), (far, 1.2))
    )
    assert one.max() > 3 and other.max() > 3
    np.testing.assert_array_equal(together, np.concatenate([one, np.where(other > 0, other + one.max(), 0)]))


@pytest.mark.parametrize("params", ADAPTIVE, ids=["PointNet", "experts", "people"])
def test_density_does_not_change_clusters_of_an_hdl_64e(params, scan):
    ground = np.isin(scan.semantic, (40, 44, 48, 49, 60, 72))
    result = cluster_obstacles(scan.frame.xyz, ground, params)
    assert result.max() > 20
    np.testing.assert_array_equal(result, cluster_obstacles(scan.frame.xyz, ground, replace(params, density=0.0)))


@needs_data
@pytest.mark.parametrize("layout", ["kitti_object", "kitti_tracking", "kitti_unlabelled", "semantickitti"])
def test_no_real_scan_of_an_hdl_64e_counts_as_sparse(layout):
    for frame in list(open_recording(DATA / layout))[:5]:
        assert measure_density(frame.load().xyz) > 1.2 * FULL_DENSITY


@pytest.mark.parametrize("params", ADAPTIVE[::2], ids=["PointNet", "people"])
def test_adaptation_keeps_objects_of_sparse_clouds_whole(params, scan):
    is_kept = np.random.default_rng(1).random(len(scan.frame)) < 0.1
    xyz = scan.frame.xyz[is_kept]
    ground = np.isin(scan.semantic[is_kept], (40, 44, 48, 49, 60, 72))

    def count_whole(params):
        """Count objects that contain most of a cluster which contains most of the object."""
        ids, count = cluster_obstacles(xyz, ground, params), 0
        for box, name in zip(scan.truth.boxes, scan.truth.labels):
            inside = ids[points_in_box(xyz, box) & ~ground]
            if name in DETECTED and len(inside) >= 5:
                main = np.bincount(inside[inside > 0], minlength=1).argmax() if inside.any() else -1
                count += (inside == main).sum() > max(len(inside), (ids == main).sum()) / 2
        return count

    unadapted = count_whole(replace(params, density=0.0))
    assert count_whole(params) >= 1.5 * unadapted and count_whole(params) >= 5
