"""Boxes, angles, ranges, usable returns and the view of a camera."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lidar_perception.camera import Camera
from lidar_perception.clustering.grid import _sort_by_height
from lidar_perception.geometry import (
    box_corners,
    horizontal_range,
    is_within,
    lower_bound,
    points_in_box,
    quantile,
    to_box_frame,
    wrap_angle,
    wrap_line,
)
from lidar_perception.types import MAX_RANGE, PointCloud, are_usable_returns

seeds = st.integers(0, 2**32 - 1)
angles = st.floats(-50, 50)
places = st.floats(-80, 80)
sizes = st.floats(0.01, 20)
some_boxes = st.tuples(places, places, places, sizes, sizes, sizes, angles).map(np.array)

# Front left, rear left, rear right, front right: counterclockwise from above.
SIGNS = (
    np.array([[1, 1, -1], [-1, 1, -1], [-1, -1, -1], [1, -1, -1], [1, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]]) / 2
)


@given(seeds)
def test_is_within_is_half_open_and_false_for_nan(seed):
    at = np.random.default_rng(seed).integers(-3, 4, (40, 7)).astype(np.float32)
    at[::5, :2] = np.nan
    low, high = (-1.0, -2.0, 5.0), (2.0, 1.0, 5.0)
    expected = [low[0] <= x < high[0] and low[1] <= y < high[1] for x, y in at[:, :2].tolist()]
    assert is_within(at, low, high).tolist() == expected
    assert is_within(at[:0], low, high).shape == (0,)


@given(some_boxes)
def test_corners_in_the_box_frame_are_at_half_the_size(box):
    corners = box_corners(box[None])[0]
    np.testing.assert_allclose(to_box_frame(corners, box), SIGNS * box[3:6], rtol=0, atol=1e-10)


@given(some_boxes, seeds)
def test_to_box_frame_inverts_a_rotation_and_translation(box, seed):
    local = np.random.default_rng(seed).uniform(-9, 9, (20, 3))
    placed = Rotation.from_euler("z", box[6]).apply(local) + box[:3]
    np.testing.assert_allclose(to_box_frame(placed, box), local, rtol=0, atol=1e-10)


def test_corners_of_many_boxes_equal_those_of_single_boxes():
    many = np.random.default_rng(0).uniform(0.1, 5, (7, 7))
    np.testing.assert_allclose(box_corners(many), [box_corners(b[None])[0] for b in many])
    assert box_corners(np.zeros((0, 7))).shape == (0, 8, 3)


@given(some_boxes, seeds, st.floats(-0.5, 3))
def test_points_in_box_equals_a_plain_implementation(box, seed, margin):
    rng = np.random.default_rng(seed)
    reach = np.hypot(*box[3:5]) + abs(margin) + 0.1
    xyz = (box[:3] + rng.uniform(-reach, reach, (200, 3))).astype(np.float32)
    inside, clear = [], []
    for point in xyz.astype(np.float64):
        x, y, z = Rotation.from_euler("z", -box[6]).apply(point - box[:3])
        depth = [box[3] / 2 + margin - abs(x), box[4] / 2 + margin - abs(y), box[5] / 2 + margin - abs(z)]
        inside.append(min(depth) >= 0)
        clear.append(abs(min(depth)) > 1e-9)
    found = points_in_box(xyz, box, margin)
    assert found.dtype == bool
    np.testing.assert_array_equal(found[clear], np.array(inside)[clear])


@given(st.integers(-40, 40), st.integers(-40, 40), st.sampled_from([0.0, np.pi]), st.sampled_from([0.0, 0.5, 2.0]))
def test_points_on_the_faces_are_inside(x, y, yaw, margin):
    box = np.array([x / 4, y / 4, 1.0, 2.0, 1.0, 1.5, 0.0])
    half = box[3:6] / 2 + margin
    for axis in range(3):
        for sign in (-1, 1):
            face = box[:3].copy()
            face[axis] += sign * half[axis]  # exact in float32
            beyond = face.copy()
            beyond[axis] += sign * 1e-3
            inward = face.copy()
            inward[axis] -= sign * 1e-3
            rotated = np.array([*box[:6], yaw])
            points = np.float32([face, beyond, inward])
            assert points_in_box(points, box, margin).tolist() == [True, False, True]
            assert points_in_box(points, rotated, margin)[1:].tolist() == [False, True]


def test_points_in_box_accepts_no_points_and_negative_sizes():
    box = np.array([1, 2, 3, 1, 1, 1, 0.5])
    assert points_in_box(np.zeros((0, 3), np.float32), box).shape == (0,)
    assert not points_in_box(np.float32([[1, 2, 3]]), box, margin=-0.6).any()


@given(st.floats(-1e4, 1e4))
def test_wrapped_angles_are_equivalent_and_in_range(angle):
    wrapped = wrap_angle(angle)
    assert -np.pi <= wrapped < np.pi
    turns = (angle - wrapped) / (2 * np.pi)
    assert abs(turns - round(turns)) < 1e-9
    line = wrap_line(angle)
    assert -np.pi / 2 <= line < np.pi / 2
    half_turns = (angle - line) / np.pi
    assert abs(half_turns - round(half_turns)) < 1e-9


def test_wrap_angle_includes_one_end_of_the_interval():
    below = np.nextafter(-np.pi, -4)
    assert wrap_angle(np.array([np.pi, -np.pi, 3 * np.pi, 0.0])).tolist() == [-np.pi, -np.pi, -np.pi, 0.0]
    assert -np.pi <= wrap_angle(below) < np.pi


@given(seeds, st.sampled_from([np.float32, np.float64]))
def test_horizontal_range_ignores_height_and_heading(seed, dtype):
    xyz = (np.random.default_rng(seed).normal(size=(50, 3)) * 40).astype(dtype)
    ranges = horizontal_range(xyz)
    assert ranges.dtype == dtype and ranges.shape == (50,)
    np.testing.assert_allclose(ranges, np.hypot(xyz[:, 0], xyz[:, 1]), rtol=1e-6)
    np.testing.assert_array_equal(ranges, horizontal_range(xyz[:, :2]))
    np.testing.assert_array_equal(ranges, horizontal_range(xyz[:, [1, 0]] * dtype([-1, 1])))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    "point, usable",
    [
        ([1, 2, 3], True),
        ([0, 0, 1e-6], True),
        ([-0.001, 0, 0], True),
        ([0, 0, 0], False),
        ([-0.0, 0, -0.0], False),
        ([np.nan, 1, 1], False),
        ([1, np.nan, 1], False),
        ([1, 1, np.nan], False),
        ([np.inf, 1, 1], False),
        ([1, -np.inf, 1], False),
        ([np.inf, -np.inf, np.nan], False),
        ([9e4, 0, 0], True),
        ([MAX_RANGE, 0, 0], True),
        ([1.001e5, 0, 0], False),
        ([8e4, 8e4, 0], False),
        ([0, 0, -1e20], False),
        ([3e38, 3e38, 3e38], False),
    ],
)
def test_usable_returns_are_finite_near_and_not_the_origin(point, usable, dtype):
    xyz = np.array([[1, 1, 1], point, [2, 2, 2]], dtype)
    found = are_usable_returns(xyz)
    assert found.dtype == bool and found.tolist() == [True, usable, True]


def test_usable_returns_accepts_strided_and_empty_arrays():
    assert are_usable_returns(np.zeros((0, 3), np.float32)).shape == (0,)
    wide = np.zeros((4, 6), np.float32)
    wide[2, 1] = 5
    assert are_usable_returns(wide[:, :3]).tolist() == [False, False, True, False]
    assert len(PointCloud(wide[:, :3])) == 4


# --- the camera ----------------------------------------------------------------------------

OPTICAL = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # camera to LiDAR axes
WIDTH, HEIGHT = 1242, 375


def make_camera(rng):
    """Return a camera like KITTI's, its rotation and translation in the LiDAR frame, and P."""
    p = np.array([[721.5, 0, 609.6, 44.9], [0, 721.5, 172.9, 0.2], [0, 0, 1, 0.003]])
    rotation = Rotation.from_rotvec(rng.normal(0, 0.05, 3)) * OPTICAL
    translation = np.array([0.27, 0, -0.08]) + rng.normal(0, 0.05, 3)
    camera = Camera.from_camera_pose(p, rotation.as_quat(), translation, WIDTH, HEIGHT)
    return camera, rotation, translation, p


@given(seeds)
def test_in_view_equals_the_float64_projection(seed):
    rng = np.random.default_rng(seed)
    camera, rotation, translation, p = make_camera(rng)
    xyz = (rng.normal(size=(2000, 3)) * [40, 20, 5]).astype(np.float32)
    in_camera = rotation.inv().apply(xyz.astype(np.float64) - translation)
    u, v, depth = p @ np.column_stack([in_camera, np.ones(len(xyz))]).T
    u, v = u / depth, v / depth
    inside = (depth > 0) & (u >= 0) & (u < WIDTH) & (v >= 0) & (v < HEIGHT)
    borders = np.abs([u, u - WIDTH, v, v - HEIGHT]).min(axis=0)
    clear = (borders > 1e-6) & (np.abs(depth) > 1e-6)
    assert inside.sum() > 50 and clear.mean() > 0.999
    np.testing.assert_array_equal(camera.in_view(xyz)[clear], inside[clear])


@given(seeds)
def test_camera_accepts_its_pose_in_either_direction(seed):
    camera, rotation, translation, p = make_camera(np.random.default_rng(seed))
    inverse = rotation.inv()
    other = Camera.from_lidar_pose(p, inverse.as_quat(), -inverse.apply(translation), WIDTH, HEIGHT)
    np.testing.assert_allclose(other.projection, camera.projection, rtol=0, atol=1e-9)


def test_image_includes_its_left_and_top_border_only():
    camera = Camera(np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]]), 2, 1)  # u = -y / x
    xyz = np.float32([[4, 0, 0], [4, -8, 0], [4, -7.99, 0], [4, 0, -4], [4, 0, -3.99], [4, 0.01, 0], [4, 0, 0.01]])
    assert camera.in_view(xyz).tolist() == [True, False, True, False, True, False, False]


def test_points_behind_the_camera_are_not_in_view():
    camera = Camera(np.array([[10, -1, 0, 0], [10, 0, -1, 0], [1, 0, 0, 0.0]]), 20, 20)
    ahead = np.float32([[5, 0, 0]])
    assert camera.in_view(ahead).tolist() == [True]
    assert camera.in_view(-ahead).tolist() == [False]
    assert camera.in_view(np.float32([[0, 0, 0], [0, 3, 1]])).tolist() == [False, False]
    assert camera.in_view(np.zeros((0, 3), np.float32)).shape == (0,)


@pytest.mark.parametrize(
    "values", [[3.0], [2.0, 1.0], [1.0] * 40, range(40), range(40, 0, -1), np.random.default_rng(0).normal(size=999)]
)
def test_quantile_and_lower_bound_equal_numpy(values):
    values = np.array(values, float)
    for share in 0.0, 0.1, 0.5, 0.77, 1.0:
        assert quantile(values.copy(), share) == pytest.approx(np.quantile(values, share), rel=1e-12, abs=1e-12)
    ascending = np.sort(values)
    for number in (*ascending[::7], -5.0, 99.0):
        assert lower_bound(ascending, number) == np.searchsorted(ascending, number)


@pytest.mark.parametrize("spread", [10, 10**6, 10**12])
def test_heights_are_sorted_stably_at_any_distance(spread):
    z = np.random.default_rng(1).integers(-spread, spread, 300)
    z[::3] = z[0]
    np.testing.assert_array_equal(_sort_by_height(z), np.argsort(z, kind="stable"))
