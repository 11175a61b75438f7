"""Laws of the ground plane: found under noise and outliers, a fixed point, None where there is
none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from samples import DATA, needs_data
from sklearn.linear_model import LinearRegression, RANSACRegressor

from lidar_perception.ground.threshold import (
    fit_plane,
    height_above,
    ransac_plane,
    segment_ground,
)
from lidar_perception.params import GroundParams

SCANS = DATA / "kitti_object/training/velodyne"
few = settings(deadline=None, max_examples=30, database=None)
slopes = st.floats(-0.15, 0.15)


def sloped_scene(seed, plane, count=3000, outliers=0.4, noise=0.02, high=4.0):
    """Noisy points of the plane within 20 m, and outliers up to `high` m above it; shuffled."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-20, 20, (count, 2))
    z = xy @ plane[:2] + plane[2] + rng.normal(0, noise, count)
    stray = rng.random(count) < outliers
    z[stray] += rng.uniform(0.3, high, stray.sum())
    return np.column_stack([xy, z]).astype(np.float32)


def angle_between(p, q):
    """Degrees between the normals of two planes."""
    n, m = (np.array([-a[0], -a[1], 1.0]) for a in (p, q))
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(n, m)), n @ m))


def apart(p, q, reach=20.0):
    """Largest distance along z of two planes within a square of 2 reach."""
    return abs(p[2] - q[2]) + reach * (abs(p[0] - q[0]) + abs(p[1] - q[1]))


def real_scans(*numbers):
    for i in numbers:
        raw = np.fromfile(sorted(SCANS.glob("*.bin"))[i], np.float32).reshape(-1, 4)
        yield np.ascontiguousarray(raw[:, :3])


@few
@given(st.integers(0, 2**31), slopes, slopes, st.floats(-3, -1.3))
def test_the_plane_is_within_1_cm_and_a_tenth_degree_under_40_percent_outliers(seed, a, b, c):
    true = np.array([a, b, c])
    xyz = sloped_scene(seed, true)
    found = ransac_plane(xyz, GroundParams(z_max=100.0))
    assert angle_between(found, true) < 0.1
    assert abs(height_above(np.zeros((1, 3)), found)[0] - height_above(np.zeros((1, 3)), true)[0]
               ) < 0.01


@few
@given(st.integers(0, 2**31), slopes, slopes)
def test_ground_is_every_candidate_within_inlier_distance_of_the_plane(seed, a, b):
    xyz = sloped_scene(seed, [a, b, -1.7])
    params = GroundParams(z_max=-1.0, inlier_distance=0.07)
    low = xyz[:, 2] < params.z_max
    plane = ransac_plane(xyz[low], params)
    x, y, z = xyz.T.astype(np.float64)
    expected = low & (abs(z - (plane[0] * x + plane[1] * y + plane[2])) <= 0.07)
    np.testing.assert_array_equal(segment_ground(xyz, params), expected)
    assert expected.sum() > 500


@few
@given(st.integers(0, 2**31), slopes, slopes, st.sampled_from([0.0, 300.0, 5000.0]))
def test_the_plane_is_a_fixed_point_of_fitting_the_ground(seed, a, b, offset):
    xyz = sloped_scene(seed, [a, b, -1.7])
    xyz[:, 0] += np.float32(offset)
    params = GroundParams(z_max=100.0)
    plane = ransac_plane(xyz, params)
    again = fit_plane(xyz[segment_ground(xyz, params)])
    np.testing.assert_allclose(again[:2], plane[:2], rtol=0, atol=1e-9)
    here = np.array([[offset, 0.0, 0.0]])
    np.testing.assert_allclose(height_above(here, again), height_above(here, plane), rtol=0,
                               atol=1e-9)


@few
@given(st.integers(0, 2**31), slopes, slopes)
def test_permuting_points_permutes_the_ground(seed, a, b):
    xyz = sloped_scene(seed, [a, b, -1.7])
    order = np.random.default_rng(seed).permutation(len(xyz))
    params = GroundParams(z_max=100.0)
    np.testing.assert_array_equal(segment_ground(xyz[order], params),
                                  segment_ground(xyz, params)[order])


@few
@given(st.integers(0, 2**31), slopes, slopes)
def test_fit_plane_is_numpys_least_squares(seed, a, b):
    xyz = sloped_scene(seed, [a, b, -1.7], count=50).astype(np.float64)
    design = np.column_stack([xyz[:, :2], np.ones(len(xyz))])
    np.testing.assert_allclose(fit_plane(xyz), np.linalg.lstsq(design, xyz[:, 2], rcond=None)[0],
                               rtol=0, atol=1e-9)


@needs_data
@pytest.mark.parametrize("scan", [0, 5, 13, 20])
def test_on_real_clouds_the_plane_is_that_of_2000_trials_of_sklearn(scan):
    xyz, = real_scans(scan)
    params = GroundParams()
    low = xyz[xyz[:, 2] < params.z_max]
    model = RANSACRegressor(LinearRegression(), residual_threshold=params.inlier_distance,
                            max_trials=2000, stop_probability=1.0, random_state=1, min_samples=3)
    sample = np.random.default_rng(0).permutation(len(low))[:5000]  # 2000 trials on all are slow
    model.fit(low[sample, :2].astype(float), low[sample, 2].astype(float))
    plane = np.array([*model.estimator_.coef_, model.estimator_.intercept_])
    for _ in range(100):  # to the fixed point on all points, as ours
        near = np.abs(height_above(low, plane)) <= params.inlier_distance
        plane, before = fit_plane(low[near]), plane
        if np.array_equal(plane, before):
            break
    found = ransac_plane(low, params)
    assert angle_between(found, plane) < 0.1
    assert abs(found[2] - plane[2]) < 0.01


@needs_data
def test_on_real_clouds_the_plane_is_a_fixed_point_and_not_a_matter_of_order_or_seed():
    for xyz in real_scans(2, 9):
        params = GroundParams()
        ground = segment_ground(xyz, params)
        plane = ransac_plane(xyz[xyz[:, 2] < params.z_max], params)
        np.testing.assert_allclose(fit_plane(xyz[ground]), plane, rtol=0, atol=1e-9)
        order = np.random.default_rng(0).permutation(len(xyz))
        for other in (segment_ground(xyz, GroundParams(seed=5)),
                      segment_ground(xyz[order], params)[np.argsort(order)]):
            assert (other != ground).mean() < 0.01
            assert apart(fit_plane(xyz[other]), plane) < 0.05


def wall(count=400):
    rng = np.random.default_rng(0)
    return np.column_stack([np.full(count, 5.0), rng.uniform(-8, 8, count),
                            rng.uniform(-4, -1.4, count)])


upside_down = sloped_scene(0, np.array([0.01, 0, -1.73]), high=2.5) * np.float32([1, -1, -1])


@pytest.mark.parametrize("xyz", [
    np.zeros((0, 3)),
    np.full((1, 3), -2.0),
    np.array([[1, 0, -2.0], [0, 1, -2]]),
    np.full((100, 3), -2.0),
    np.linspace(1, 9, 65)[:, None] * [1, 0, 0] - [0, 0, 2],
    np.linspace(1, 9, 65)[:, None] * [1, 2, 0] - [0, 0, 2],
    np.linspace(1, 9, 65)[:, None] * [0, 0, -1] - [4, 4, 2],
    wall(),
    sloped_scene(0, [0, 0, 0.5]),
    upside_down,
], ids=["empty", "one point", "two points", "all equal", "line", "slanted line", "pole", "wall",
        "all above z_max", "upside-down sensor"])
def test_where_there_is_no_ground_nothing_is(xyz):
    ground = segment_ground(xyz.astype(np.float32))
    assert ground.shape == (len(xyz),) and ground.dtype == bool and not ground.any()


def test_three_points_are_enough_for_a_plane():
    xyz = np.float32([[0, 0, -2], [4, 0, -2.5], [0, 4, -1.75]])
    np.testing.assert_allclose(ransac_plane(xyz, GroundParams()), [-0.125, 0.0625, -2], atol=1e-9)
    assert segment_ground(xyz).all()


def test_fit_plane_needs_three_points_not_on_a_line():
    assert fit_plane(np.zeros((0, 3), np.float32)) is None
    assert fit_plane(np.float32([[0, 0, 0], [1, 0, 0]])) is None
    assert fit_plane(np.float32([[0, 0, 0], [1, 1, 0], [2, 2, 5], [5, 5, 1]])) is None
    assert fit_plane(np.float32([[0, 0, 0], [1, 1, 0], [2, 2, 5], [5, 6, 1]])) is not None


def test_a_plane_steeper_than_max_slope_is_not_ground():
    steep = sloped_scene(1, [np.tan(np.radians(20)), 0, -20], outliers=0, noise=0.0)
    assert segment_ground(steep, GroundParams(max_slope=21.0, z_max=0.0)).mean() > 0.9
    assert not segment_ground(steep, GroundParams(max_slope=5.0, z_max=0.0)).any()


def test_points_at_z_max_are_not_ground_and_nothing_above_it_is():
    xyz = sloped_scene(2, [0, 0, -1.3], outliers=0)
    xyz[0] = [0, 0, -1.25]
    params = GroundParams(z_max=-1.25)
    ground = segment_ground(xyz, params)
    assert not ground[0] and ground.sum() > 2900
    assert (xyz[ground, 2] < np.float32(-1.25)).all()


def test_same_seed_same_ground_and_the_input_stays_unchanged():
    xyz = sloped_scene(3, [0.05, 0.02, -1.8])
    before = xyz.copy()
    first = segment_ground(xyz)
    np.testing.assert_array_equal(segment_ground(xyz), first)
    np.testing.assert_array_equal(xyz, before)
