"""The density of a cloud, and clustering that follows it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from samples import DATA, needs_data

from lidar_perception.candidates.configurations import BEST
from lidar_perception.classes import DETECTED
from lidar_perception.clustering import density as density_module
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.clustering.density import FEWEST, WIDEST, density, followed, radii
from lidar_perception.clustering.euclidean import euclidean
from lidar_perception.clustering.params import FULL_DENSITY, ClusteringParams, EuclideanParams
from lidar_perception.data.open import open_recording
from lidar_perception.detectors.pointnet.config import PointNetConfig
from lidar_perception.detectors.pointpillars.params import EXPERT_CLUSTERING
from lidar_perception.geometry import points_in_box
from lidar_perception.simulation.drive import scan_at
from lidar_perception.simulation.sensor import HDL64E

FOLLOWING = (PointNetConfig().clustering, EXPERT_CLUSTERING, BEST.clustering)


@pytest.fixture(scope="module")
def scan():
    return scan_at(4, 0, HDL64E)


def returns(up, aside, rng, lowest=-25.0, highest=5.0):
    """A scan with these steps in degrees, of surfaces anywhere from 2 to 60 m away."""
    elevation, azimuth = np.radians(np.meshgrid(np.arange(lowest, highest, up),
                                                np.arange(-180, 180, aside)))
    away = rng.uniform(2, 60, elevation.shape)
    return np.stack([away * np.cos(elevation) * np.cos(azimuth),
                     away * np.cos(elevation) * np.sin(azimuth),
                     away * np.sin(elevation)], axis=-1).reshape(-1, 3).astype(np.float32)


@pytest.mark.parametrize("up, aside", [(0.4, 0.17), (0.5, 0.5), (1.33, 0.33), (2.0, 0.2),
                                       (2.0, 2.0)])
def test_density_is_that_of_the_sensors_steps_wherever_the_surfaces_are(up, aside):
    # A beam makes 1 / aside returns a degree of azimuth, however steep it looks.
    slant = np.cos(np.radians(np.arange(-25.0, 5.0, up))).mean()
    expected = 1 / (up * aside * slant)
    # Cells that a beam of every second one, or the end of the view, halves: the point itself counts
    # too little there.
    assert density(returns(up, aside, np.random.default_rng(3))) == pytest.approx(
        expected, rel=0.12, abs=0.3)


@pytest.fixture(scope="module")
def of_all(scan):
    """The scan's density if every point of it is looked at."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(density_module, "LOOKED_AT", len(scan.frame.xyz))
        return density(scan.frame.xyz)


@settings(max_examples=10, database=None)
@given(st.floats(0.05, 1.0), st.integers(0, 99))
def test_density_is_the_share_of_the_points_that_is_left(scan, of_all, share, seed):
    xyz = scan.frame.xyz
    kept = np.random.default_rng(seed).random(len(xyz)) < share
    assert density(xyz[kept]) == pytest.approx(share * of_all, rel=0.08)


def test_density_of_a_cropped_cloud_is_that_of_the_whole(scan):
    xyz = scan.frame.xyz
    assert density(xyz[xyz[:, 0] > 5]) == pytest.approx(density(xyz), rel=0.1)
    assert density(xyz * np.float32(0.1)) == pytest.approx(density(xyz), rel=1e-3)


def test_clouds_that_say_nothing_of_density_change_no_number():
    lonely = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    unusable = np.array([[0, 0, 0], [np.nan, 1, 1], [np.inf, 0, 0]], np.float32)
    for xyz in (np.zeros((0, 3), np.float32), lonely, unusable):
        assert density(xyz) == 0.0
    for params in FOLLOWING:
        for seen in (0.0, FULL_DENSITY, 15.0, 1e9):
            assert followed(params, seen) is params
    assert followed(ClusteringParams(), 0.1) == ClusteringParams()


@given(st.floats(1e-9, FULL_DENSITY), st.floats(1e-9, FULL_DENSITY))
def test_the_thinner_the_wider_and_the_fewer(a, b):
    thin, dense = sorted([a, b])
    for params in FOLLOWING:
        wide, narrow = followed(params, thin), followed(params, dense)
        for one, other, given_ in zip(wide.dbscan.eps, narrow.dbscan.eps, params.dbscan.eps):
            assert given_ <= other <= one <= WIDEST * given_ * (1 + 1e-9)
        assert wide.euclidean.radius >= narrow.euclidean.radius >= params.euclidean.radius
        assert wide.euclidean.beta <= narrow.euclidean.beta <= params.euclidean.beta
        assert FEWEST - 1 <= wide.dbscan.min_samples <= narrow.dbscan.min_samples
        assert FEWEST <= wide.euclidean.min_size <= narrow.euclidean.min_size


def test_each_point_has_the_radius_of_its_range():
    away = np.array([0.1, 5.0, 10.0, 20.0, 40.0, 80.0])
    xyz = np.column_stack([away, np.zeros((6, 2))]).astype(np.float32)
    found = radii(xyz, 1.5, 0.5, 1.3)
    assert found.min() == 0.5 and found.max() == 1.3 and (np.diff(found) >= 0).all()
    assert radii(xyz, 6.0, 0.0, 99.0) == pytest.approx(radii(xyz, 1.5, 0.0, 99.0) / 2)


def test_places_with_other_radii_are_clustered_as_each_by_itself():
    rng = np.random.default_rng(8)
    params = EuclideanParams(gamma=0.0, beta=0.0, min_size=3)
    near, far = (rng.uniform(-6, 6, (600, 3)).astype(np.float32) + [x, 0, 0] for x in (0, 500))
    together = euclidean(np.concatenate([near, far]), params,
                         radii=np.repeat([0.5, 1.2], 600))
    one, other = (euclidean(xyz.astype(np.float32), replace(params, radius=radius))
                  for xyz, radius in ((near, 0.5), (far, 1.2)))
    assert one.max() > 3 and other.max() > 3
    np.testing.assert_array_equal(together, np.concatenate(
        [one, np.where(other > 0, other + one.max(), 0)]))


@pytest.mark.parametrize("params", FOLLOWING, ids=["PointNet", "experts", "people"])
def test_clusters_of_an_hdl_64e_are_as_if_nothing_followed(params, scan):
    ground = np.isin(scan.semantic, (40, 44, 48, 49, 60, 72))
    found = cluster_obstacles(scan.frame.xyz, ground, params)
    assert found.max() > 20
    np.testing.assert_array_equal(found, cluster_obstacles(scan.frame.xyz, ground,
                                                           replace(params, density=0.0)))


@needs_data
@pytest.mark.parametrize("layout", ["kitti_object", "kitti_tracking", "kitti_unlabelled",
                                    "semantickitti"])
def test_no_real_scan_of_an_hdl_64e_counts_as_thin(layout):
    for frame in list(open_recording(DATA / layout))[:5]:
        assert density(frame.load().xyz) > 1.2 * FULL_DENSITY


@pytest.mark.parametrize("params", FOLLOWING[::2], ids=["PointNet", "people"])
def test_objects_of_a_scan_with_a_tenth_of_the_points_stay_whole(params, scan):
    kept = np.random.default_rng(1).random(len(scan.frame)) < 0.1
    xyz = scan.frame.xyz[kept]
    ground = np.isin(scan.semantic[kept], (40, 44, 48, 49, 60, 72))

    def whole(params):
        """Objects most of whose points are one cluster, which is mostly of them."""
        ids, count = cluster_obstacles(xyz, ground, params), 0
        for box, name in zip(scan.truth.boxes, scan.truth.labels):
            own = ids[points_in_box(xyz, box) & ~ground]
            if name in DETECTED and len(own) >= 5:
                most = np.bincount(own[own > 0], minlength=1).argmax() if own.any() else -1
                count += (own == most).sum() > max(len(own), (ids == most).sum()) / 2
        return count
    assert whole(params) >= 1.5 * whole(replace(params, density=0.0)) and whole(params) >= 5
