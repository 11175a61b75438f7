"""Properties of the ground plane: robust to noise and outliers, and a fixed point of fitting."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import DATA, needs_data
from sklearn.linear_model import LinearRegression, RANSACRegressor

from lidar_perception.ground.params import ThresholdParams
from lidar_perception.ground.threshold import (
    compute_height_above_plane,
    find_plane,
    fit_plane,
    fit_plane_by_ransac,
    segment_by_threshold,
)

SCANS = DATA / "kitti_object/training/velodyne"
slopes = st.floats(-0.15, 0.15)


def make_sloped_scene(seed, plane, count=3000, outliers=0.4, noise=0.02, max_outlier=4.0):
    """Return noisy points of the plane within 20 m, and outliers up to max_outlier m above it."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-20, 20, (count, 2))
    z = xy @ plane[:2] + plane[2] + rng.normal(0, noise, count)
    stray = rng.random(count) < outliers
    z[stray] += rng.uniform(0.3, max_outlier, stray.sum())
    return np.column_stack([xy, z]).astype(np.float32)


def compute_angle(p, q):
    """Return the angle between the normals of two planes, in degrees."""
    n, m = (np.array([-a[0], -a[1], 1.0]) for a in (p, q))
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(n, m)), n @ m))


def compute_max_distance(p, q, reach=20.0):
    """Return the largest distance along z of two planes for |x|, |y| <= reach."""
    return abs(p[2] - q[2]) + reach * (abs(p[0] - q[0]) + abs(p[1] - q[1]))


def load_real_scans(*numbers):
    for i in numbers:
        raw = np.fromfile(sorted(SCANS.glob("*.bin"))[i], np.float32).reshape(-1, 4)
        yield np.ascontiguousarray(raw[:, :3])


@given(st.integers(0, 2**31), slopes, slopes, st.floats(-3, -1.3))
def test_plane_is_accurate_with_40_percent_outliers(seed, a, b, c):
    true = np.array([a, b, c])
    xyz = make_sloped_scene(seed, true)
    result = fit_plane_by_ransac(xyz, ThresholdParams(max_height=100.0))
    assert compute_angle(result, true) < 0.1
    assert abs(result[2] - true[2]) < 0.01


@given(st.integers(0, 2**31), slopes, slopes)
def test_all_points_within_inlier_distance_are_ground(seed, a, b):
    xyz = make_sloped_scene(seed, [a, b, -1.7])
    params = ThresholdParams(max_height=0.73, inlier_distance=0.07)
    plane = find_plane(xyz, params, sensor_height=1.73)
    x, y, z = xyz.T.astype(np.float64)
    expected = abs(z - (plane[0] * x + plane[1] * y + plane[2])) <= 0.07
    np.testing.assert_array_equal(segment_by_threshold(xyz, params), expected)
    assert expected.sum() > 500


@given(st.integers(0, 2**31), slopes, slopes, st.sampled_from([0.0, 300.0, 5000.0]))
def test_fitting_the_ground_of_a_plane_keeps_the_plane(seed, a, b, offset):
    xyz = make_sloped_scene(seed, [a, b, -1.7])
    xyz[:, 0] += np.float32(offset)
    params = ThresholdParams(max_height=100.0)
    plane = fit_plane_by_ransac(xyz, params)
    refitted = fit_plane(xyz[segment_by_threshold(xyz, params)])
    np.testing.assert_allclose(refitted[:2], plane[:2], rtol=0, atol=1e-9)
    origin = np.array([[offset, 0.0, 0.0]])
    np.testing.assert_allclose(
        compute_height_above_plane(origin, refitted), compute_height_above_plane(origin, plane), rtol=0, atol=1e-9
    )


@given(st.integers(0, 2**31), slopes, slopes)
def test_permuting_points_permutes_the_ground(seed, a, b):
    xyz = make_sloped_scene(seed, [a, b, -1.7])
    order = np.random.default_rng(seed).permutation(len(xyz))
    params = ThresholdParams(max_height=100.0)
    np.testing.assert_array_equal(segment_by_threshold(xyz[order], params), segment_by_threshold(xyz, params)[order])


@given(st.integers(0, 2**31), slopes, slopes)
def test_fit_plane_equals_numpy_least_squares(seed, a, b):
    xyz = make_sloped_scene(seed, [a, b, -1.7], count=50).astype(np.float64)
    design = np.column_stack([xyz[:, :2], np.ones(len(xyz))])
    np.testing.assert_allclose(fit_plane(xyz), np.linalg.lstsq(design, xyz[:, 2], rcond=None)[0], rtol=0, atol=1e-9)


@needs_data
@pytest.mark.parametrize("scan", [0, 5, 13, 20])
def test_plane_of_a_real_cloud_equals_sklearn_ransac(scan):
    (xyz,) = load_real_scans(scan)
    params = ThresholdParams()
    low = xyz[xyz[:, 2] < -1.3]
    model = RANSACRegressor(
        LinearRegression(),
        residual_threshold=params.inlier_distance,
        max_trials=2000,
        stop_probability=1.0,
        random_state=1,
        min_samples=3,
    )
    sample = np.random.default_rng(0).permutation(len(low))[:5000]  # 2000 trials on all points would be slow
    model.fit(low[sample, :2].astype(float), low[sample, 2].astype(float))
    plane = np.array([*model.estimator_.coef_, model.estimator_.intercept_])
    for _ in range(100):  # refine to the fixed point on all points, like the implementation
        near = np.abs(compute_height_above_plane(low, plane)) <= params.inlier_distance
        plane, before = fit_plane(low[near]), plane
        if np.array_equal(plane, before):
            break
    result = fit_plane_by_ransac(low, params)
    assert compute_angle(result, plane) < 0.1
    assert abs(result[2] - plane[2]) < 0.01


@needs_data
def test_plane_of_a_real_cloud_ignores_order_and_seed():
    for xyz in load_real_scans(2, 9):
        params = ThresholdParams()
        ground = segment_by_threshold(xyz, params)
        plane = find_plane(xyz, params)
        np.testing.assert_allclose(fit_plane(xyz[ground]), plane, rtol=0, atol=1e-9)
        order = np.random.default_rng(0).permutation(len(xyz))
        for other in (
            segment_by_threshold(xyz, ThresholdParams(seed=5)),
            segment_by_threshold(xyz[order], params)[np.argsort(order)],
        ):
            assert (other != ground).mean() < 0.01
            assert compute_max_distance(fit_plane(xyz[other]), plane) < 0.05


def wall(count=400):
    rng = np.random.default_rng(0)
    return np.column_stack([np.full(count, 5.0), rng.uniform(-8, 8, count), rng.uniform(-4, -1.4, count)])


upside_down = make_sloped_scene(0, np.array([0.01, 0, -1.73]), max_outlier=2.5) * np.float32([1, -1, -1])


@pytest.mark.parametrize(
    "xyz",
    [
        np.zeros((0, 3)),
        np.full((1, 3), -2.0),
        np.array([[1, 0, -2.0], [0, 1, -2]]),
        np.full((100, 3), -2.0),
        np.linspace(1, 9, 65)[:, None] * [1, 0, 0] - [0, 0, 2],
        np.linspace(1, 9, 65)[:, None] * [1, 2, 0] - [0, 0, 2],
        np.linspace(1, 9, 65)[:, None] * [0, 0, -1] - [4, 4, 2],
        wall(),
        make_sloped_scene(0, [0, 0, 0.5]),
        upside_down,
    ],
    ids=[
        "empty",
        "one point",
        "two points",
        "all equal",
        "line",
        "slanted line",
        "pole",
        "wall",
        "all above max_height",
        "upside-down sensor",
    ],
)
def test_clouds_without_ground_give_an_empty_mask(xyz):
    ground = segment_by_threshold(xyz.astype(np.float32))
    assert ground.shape == (len(xyz),) and ground.dtype == bool and not ground.any()


def test_plane_is_fitted_to_three_points():
    xyz = np.float32([[0, 0, -2], [4, 0, -2.5], [0, 4, -1.75]])
    np.testing.assert_allclose(fit_plane_by_ransac(xyz, ThresholdParams()), [-0.125, 0.0625, -2], atol=1e-9)
    assert segment_by_threshold(xyz).all()


def test_fit_plane_needs_three_points_not_on_a_line():
    assert fit_plane(np.zeros((0, 3), np.float32)) is None
    assert fit_plane(np.float32([[0, 0, 0], [1, 0, 0]])) is None
    assert fit_plane(np.float32([[0, 0, 0], [1, 1, 0], [2, 2, 5], [5, 5, 1]])) is None
    assert fit_plane(np.float32([[0, 0, 0], [1, 1, 0], [2, 2, 5], [5, 6, 1]])) is not None


def test_plane_steeper_than_max_slope_is_not_ground():
    steep = make_sloped_scene(1, [np.tan(np.radians(20)), 0, -20], outliers=0, noise=0.0)
    assert segment_by_threshold(steep, ThresholdParams(max_slope=21.0, max_height=5.0)).mean() > 0.9
    assert not segment_by_threshold(steep, ThresholdParams(max_slope=5.0, max_height=5.0)).any()


def test_ground_continues_where_the_road_rises_above_max_height():
    # A slope of 12 degrees is 4 m high at 20 m; a threshold on z would end after 2 m.
    xyz = make_sloped_scene(2, [0.2, 0, -1.73], outliers=0.3)
    on_plane = np.abs(compute_height_above_plane(xyz, np.array([0.2, 0, -1.73]))) < 0.05
    ground = segment_by_threshold(xyz)
    assert ground[on_plane].mean() > 0.99 and ground[xyz[:, 0] > 10].sum() > 400
    assert ground.sum() < 1.1 * on_plane.sum()


def test_max_height_is_relative_to_the_ground_below_the_sensor():
    """A second, larger plane 0.5 m higher counts only if max_height reaches it."""
    rng = np.random.default_rng(0)
    floor, table = (
        np.column_stack([rng.uniform(-9, 9, (n, 2)), np.full(n, z)]).astype(np.float32)
        for n, z in ((300, -0.7), (900, -0.2))
    )
    xyz = np.concatenate([floor, table])
    for height, max_height, expected in ((0.7, 0.43, -0.7), (0.7, 0.6, -0.2), (0.2, 0.1, -0.2)):
        plane = find_plane(xyz, ThresholdParams(max_height=max_height), sensor_height=height)
        np.testing.assert_allclose(plane, [0, 0, expected], atol=1e-6)


def test_result_is_repeatable_and_the_input_not_modified():
    xyz = make_sloped_scene(3, [0.05, 0.02, -1.8])
    before = xyz.copy()
    first = segment_by_threshold(xyz)
    np.testing.assert_array_equal(segment_by_threshold(xyz), first)
    np.testing.assert_array_equal(xyz, before)


@given(st.integers(0, 2**31), slopes, slopes)
def test_height_threshold_removes_all_low_points(seed, a, b):
    xyz = make_sloped_scene(seed, [a, b, -1.7])
    np.testing.assert_array_equal(
        segment_by_threshold(xyz, ThresholdParams(separate="height")), xyz[:, 2] < np.float32(-1.3)
    )
