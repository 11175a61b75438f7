"""Boxes, ellipses and classes of clusters."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import DATA, needs_data
from scipy.spatial import ConvexHull

from lidar_perception.clustering.params import BOX_SHAPES
from lidar_perception.clustering.shapes import classify_by_diagonal, fit_boxes, fit_ellipses
from lidar_perception.data.open import open_recording
from lidar_perception.geometry import box_corners, points_in_box
from lidar_perception.types import CLASSES

seeds = st.integers(0, 2**32 - 1)
QUARTER_TURN = np.float32(np.pi / 2)
each_shape = pytest.mark.parametrize("shape", BOX_SHAPES)
each_oriented = pytest.mark.parametrize("shape", ["min_area", "l_shape"])


def rotate(xyz, yaw):
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.asarray(xyz, float) @ [[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]


def make_clusters(seed):
    """Return points (N, 3) float32 of several clusters in mixed order, and labels with noise."""
    rng = np.random.default_rng(seed)
    parts = []
    for k in range(1, rng.integers(2, 9)):
        size = rng.integers(1, 60)
        flat = rng.normal(size=(size, 3)) * rng.uniform(0.02, 3, 3)
        if k % 3 == 0:
            flat = np.round(flat * 2) / 2  # ties and coincident points
        parts.append(np.column_stack([rotate(flat, rng.uniform(-4, 4)) + rng.uniform(-60, 60, 3), np.full(size, k)]))
    noise = np.column_stack([rng.uniform(-60, 60, (20, 3)), np.zeros(20)])
    points = rng.permutation(np.concatenate([noise, *parts]))
    return points[:, :3].astype(np.float32), points[:, 3].astype(np.int32)


def apply_to_one(function, xyz, *rest):
    """Apply the function to points of a single cluster and return its row."""
    xyz = np.asarray(xyz, np.float32).reshape(-1, 3)
    return function(xyz, np.ones(len(xyz), np.int32), *rest)[0]


def compute_least_area(xy):
    """Return the area of the smallest enclosing rectangle, from all edges of SciPy's convex hull."""
    hull = ConvexHull(xy.astype(float))
    normals = hull.equations[:, :2]
    along = normals @ [[0, 1], [-1, 0]] @ hull.points.T
    return (np.ptp(along, axis=1) * np.ptp(normals @ hull.points.T, axis=1)).min()


def make_l_shaped_car(rng, yaw, noise=0.01):
    """Return points on the two visible sides of a car, and its box."""
    length, width, height = rng.uniform(3.6, 4.8), rng.uniform(1.5, 1.9), rng.uniform(1.3, 1.7)
    first, second = rng.integers(60, 150), rng.integers(40, 80)
    x = np.concatenate([np.linspace(-1, 1, first), np.full(second, -1)]) * length / 2
    y = np.concatenate([np.full(first, -1), np.linspace(-1, 1, second)]) * width / 2
    flat = np.column_stack([x, y, rng.uniform(-0.5, 0.5, len(x)) * height])
    flat[:, :2] += rng.uniform(-noise, noise, (len(x), 2))
    centre = rng.uniform(-30, 30, 3)
    return ((rotate(flat, yaw) + centre).astype(np.float32), np.array([*centre, length, width, height, yaw]))


def compute_angle(a, b, period=np.pi):
    return np.abs((np.asarray(a) - b + period / 2) % period - period / 2)


def assert_rotated(before, after, angle, atol):
    """Assert that `after` is `before` rotated about z, with corners in any order."""
    result, expected = box_corners(np.stack([after, before]))[:, :4]
    distances = np.linalg.norm(result[:, None] - rotate(expected, angle), axis=2)
    assert distances.min(axis=1).max() < atol and distances.min(axis=0).max() < atol


@each_shape
@given(seeds)
def test_box_is_the_smallest_around_its_points(shape, seed):
    xyz, labels = make_clusters(seed)
    boxes = fit_boxes(xyz, labels, shape)
    assert boxes.dtype == np.float32 and boxes.shape == (labels.max(), 7)
    for k, box in enumerate(boxes, 1):
        members = xyz[labels == k]
        assert points_in_box(members, box, 1e-4).all()
        assert box[5] == pytest.approx(np.ptp(members[:, 2]), abs=1e-5)
        for side in range(2):
            smaller = box.copy()
            smaller[3 + side] -= 1e-3
            assert smaller[3 + side] < 0 or not points_in_box(members, smaller).all()


@each_oriented
@given(seeds)
def test_rotated_boxes_are_longer_than_wide(shape, seed):
    boxes = fit_boxes(*make_clusters(seed), shape)
    assert (boxes[:, 3] >= boxes[:, 4]).all() and (boxes[:, 4:6] >= 0).all()
    assert (boxes[:, 6] >= -QUARTER_TURN).all() and (boxes[:, 6] < QUARTER_TURN).all()


@given(seeds)
def test_axis_aligned_boxes_span_minimum_to_maximum(seed):
    xyz, labels = make_clusters(seed)
    boxes = fit_boxes(xyz, labels, "axis_aligned")
    assert boxes.shape == (labels.max(), 7) and boxes.dtype == np.float32
    for k, box in enumerate(boxes, start=1):
        low, high = xyz[labels == k].min(axis=0), xyz[labels == k].max(axis=0)
        np.testing.assert_array_equal(box, [*(low + high) / 2, *(high - low), 0])


@given(seeds, st.floats(0, 2 * np.pi))
def test_min_area_box_has_the_least_area(seed, angle):
    rng = np.random.default_rng(seed)
    xyz = rotate(rng.normal(size=(rng.integers(4, 300), 3)) * [3, 1, 1], rng.uniform(0, 4))
    xyz = (xyz + rng.uniform(-50, 50, 3)).astype(np.float32)
    box = apply_to_one(fit_boxes, xyz, "min_area").astype(float)
    area = box[3] * box[4]
    assert area == pytest.approx(compute_least_area(xyz[:, :2]), rel=1e-5)
    _, sides, _ = cv2.minAreaRect(xyz[:, :2] - xyz[0, :2])
    assert area <= sides[0] * sides[1] * (1 + 1e-4)
    spans = np.ptp(rotate(xyz, angle), axis=0)
    assert area <= spans[0] * spans[1] * (1 + 1e-6)
    for other in (apply_to_one(fit_boxes, xyz, shape) for shape in BOX_SHAPES):
        assert area <= other[3] * other[4] * (1 + 1e-5)


@given(seeds, st.integers(3, 400), st.floats(0.5, 2000))
def test_min_area_box_of_convex_points_has_the_least_area(seed, count, radius):
    angles = np.random.default_rng(seed).uniform(0, 2 * np.pi, count)
    xyz = np.column_stack([np.cos(angles), 0.7 * np.sin(angles), angles]) * radius
    xyz = xyz.astype(np.float32)
    box = apply_to_one(fit_boxes, xyz, "min_area").astype(float)
    assert box[3] * box[4] == pytest.approx(compute_least_area(xyz[:, :2]), rel=1e-5)


@given(seeds, st.floats(-10, 10))
def test_rotating_a_cloud_rotates_its_min_area_box(seed, angle):
    # Points that fill a rectangle, and its corners: no other rectangle has a similar area.
    rng = np.random.default_rng(seed)
    sides = np.array([rng.uniform(3, 5), rng.uniform(1, 2), 1])
    corners = [[1, 1, 1], [1, -1, 1], [-1, -1, 1], [-1, 1, 1]]
    flat = np.concatenate([rng.uniform(-1, 1, (100, 3)), corners]) * sides / 2
    xyz = rotate(flat, rng.uniform(0, 7)) + rng.uniform(-20, 20, 3)
    before = apply_to_one(fit_boxes, xyz, "min_area")
    assert_rotated(before, apply_to_one(fit_boxes, rotate(xyz, angle), "min_area"), angle, 1e-4)


@given(seeds, st.integers(-720, 720).map(np.radians))
def test_rotating_a_car_rotates_its_l_shape_box(seed, angle):
    # A rotation by an integer number of degrees maps the tested angles onto themselves.
    rng = np.random.default_rng(seed)
    xyz, _ = make_l_shaped_car(rng, np.radians(rng.integers(0, 360) + 0.2))
    before = apply_to_one(fit_boxes, xyz, "l_shape")
    assert_rotated(before, apply_to_one(fit_boxes, rotate(xyz, angle), "l_shape"), angle, 1e-3)


@given(seeds, st.floats(-np.pi, np.pi))
def test_l_shape_recovers_a_car_from_two_sides(seed, yaw):
    xyz, car = make_l_shaped_car(np.random.default_rng(seed), yaw)
    box = apply_to_one(fit_boxes, xyz, "l_shape")
    assert np.degrees(compute_angle(box[6], yaw)) < 2
    assert np.linalg.norm(box[:2] - car[:2]) < 0.05
    np.testing.assert_allclose(box[3:5], car[3:5], atol=0.1)


def test_l_shape_recovers_yaw_where_min_area_fails():
    # Two equally long sides form a triangle; its smallest rectangle is along the longest edge.
    side, rng = np.linspace(0, 1.6, 80), np.random.default_rng(0)
    flat = np.zeros((160, 3))
    flat[:80, 0] = flat[80:, 1] = side
    xyz = rotate(flat + rng.uniform(-0.01, 0.01, flat.shape), 0.5)
    yaws = [apply_to_one(fit_boxes, xyz, shape)[6] for shape in ("l_shape", "min_area")]
    errors = np.degrees(compute_angle(yaws, 0.5, np.pi / 2))
    assert errors[0] < 1 and errors[1] > 30


@each_shape
@given(seeds)
def test_order_of_the_points_does_not_matter(shape, seed):
    xyz, labels = make_clusters(seed)
    order = np.random.default_rng(seed).permutation(len(xyz))
    np.testing.assert_array_equal(fit_boxes(xyz[order], labels[order], shape), fit_boxes(xyz, labels, shape))


@each_shape
def test_box_of_a_cluster_does_not_depend_on_others(shape):
    xyz, labels = make_clusters(5)
    boxes, rounds = fit_boxes(xyz, labels, shape), fit_ellipses(xyz, labels)
    for k, (box, ellipse) in enumerate(zip(boxes, rounds), 1):
        np.testing.assert_array_equal(box, apply_to_one(fit_boxes, xyz[labels == k], shape))
        np.testing.assert_array_equal(ellipse, apply_to_one(fit_ellipses, xyz[labels == k]))


@pytest.mark.parametrize(
    "name, xyz, length, yaw",
    [
        ("one point", [[3, -4, 1]], 0, 0),
        ("all equal", np.full((50, 3), 7.3), 0, 0),
        ("a column", [[3, -4, z] for z in range(9)], 0, 0),
        ("along x", np.outer(np.linspace(-2, 3, 40), [1, 0, 0]), 5, 0),
        ("along y", np.outer(np.linspace(-2, 3, 40), [0, 1, 0]), 5, -np.pi / 2),
        ("zero of either sign", [[0.0, 3, 0], [-0.0, 7, 0], [0.0, 1, 0], [-0.0, 5, 0]], 6, -np.pi / 2),
        ("almost along y", [[0, 0, 0], [1e-8, 5, 0]], 5, -np.pi / 2),
        ("slanted", np.outer(np.linspace(0, 7, 2), [np.cos(0.123), np.sin(0.123), 0]), 7, 0.123),
        ("slanted back", np.outer(np.linspace(0, 7, 333), [0.6, -0.8, 0]), 7, np.arctan2(-4, 3)),
    ],
)
def test_coincident_or_collinear_points_have_a_box(name, xyz, length, yaw):
    for shape in ("min_area", "l_shape"):
        box = apply_to_one(fit_boxes, xyz, shape)
        np.testing.assert_allclose(box[3:5], [length, 0], atol=2e-6)
        assert compute_angle(box[6], yaw) < 1e-5 and -QUARTER_TURN <= box[6] < QUARTER_TURN
    ellipse = apply_to_one(fit_ellipses, xyz)
    assert ellipse[2] >= length / 2 and ellipse[3] == pytest.approx(0, abs=1e-5)
    assert length == 0 or compute_angle(ellipse[4], yaw) < 1e-5


@each_shape
def test_boxes_of_unused_cluster_ids_are_zero(shape):
    empty = np.zeros((0, 3), np.float32), np.zeros(0, np.int32)
    noise = np.ones((5, 3), np.float32), np.zeros(5, np.int32)
    for cloud in (empty, noise):
        assert (fit_boxes(*cloud, shape).shape, fit_ellipses(*cloud).shape) == ((0, 7), (0, 5))
    xyz, labels = np.array([[1, 2, 3], [2, 2, 5], [9, 9, 9]], np.float32), np.array([3, 3, 0])
    assert not fit_boxes(xyz, labels, shape)[:2].any() and not fit_ellipses(xyz, labels)[:2].any()
    np.testing.assert_array_equal(fit_boxes(xyz, labels, shape)[2], [1.5, 2, 4, 1, 0, 2, 0])
    with pytest.raises(ValueError, match="'round' must be one of axis_aligned, min_area, l_shape"):
        fit_boxes(xyz, labels, "round")


@each_shape
def test_layout_and_dtype_of_the_input_do_not_matter(shape):
    xyz, labels = make_clusters(9)
    boxes, before = fit_boxes(xyz, labels, shape), xyz.copy()
    for same in (np.asfortranarray(xyz), xyz.astype(float), np.hstack([xyz, xyz])[:, :3]):
        np.testing.assert_array_equal(fit_boxes(same, labels, shape), boxes)
        np.testing.assert_array_equal(fit_ellipses(same, labels), fit_ellipses(xyz, labels))
    np.testing.assert_array_equal(xyz, before)


@given(seeds, st.floats(-np.pi / 2, np.pi / 2), st.floats(0.2, 0.8))
def test_ellipse_of_uniform_points_is_recovered(seed, yaw, ratio):
    rng = np.random.default_rng(seed)
    radius, angle = np.sqrt(rng.uniform(0, 1, 20_000)), rng.uniform(0, 2 * np.pi, 20_000)
    axes = 3 * np.array([1, ratio])
    flat = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), angle]) * [*axes, 1]
    centre = rng.uniform(-40, 40, 3)
    ellipse = apply_to_one(fit_ellipses, rotate(flat, yaw) + centre)
    np.testing.assert_allclose(ellipse[:2], centre[:2], atol=0.08)
    np.testing.assert_allclose(ellipse[2:4], axes, rtol=0.03)
    assert compute_angle(ellipse[4], yaw) < 0.1
    assert -QUARTER_TURN <= ellipse[4] < QUARTER_TURN


@pytest.mark.parametrize(
    "diagonal, name",
    [
        (0, None),
        (0.39, None),
        (0.40, "Pedestrian"),
        (1.71, "Pedestrian"),
        (1.719, "Pedestrian"),
        (1.72, "Cyclist"),
        (2.99, "Cyclist"),
        (2.999, "Cyclist"),
        (3.00, "Car"),
        (6.40, "Car"),
        (6.41, None),
        (np.nan, None),
    ],
)
def test_class_by_diagonal_includes_the_limits(diagonal, name):
    boxes = np.array([[0, 0, 0, diagonal, 0, 9, 1], [0, 0, 0, 0, diagonal, 9, 1]])
    expected = -1 if name is None else CLASSES.index(name)
    for same in (boxes, boxes.astype(np.float32)):
        ids = classify_by_diagonal(same)
        assert ids.dtype == np.int32 and ids.tolist() == [expected] * 2


def test_class_by_diagonal_uses_length_and_width():
    boxes = np.array([[0, 0, 0, 2.5, 1.8, 1.5, 1], [0, 0, 0, 1.7, 0.6, 1.7, 0]])
    assert classify_by_diagonal(boxes).tolist() == [CLASSES.index("Car"), CLASSES.index("Cyclist")]
    assert classify_by_diagonal(np.zeros((0, 7))).shape == (0,)


@needs_data
def test_boxes_of_real_cars_have_the_yaw_of_the_cars():
    errors = {"min_area": [], "l_shape": []}
    for frame in open_recording(DATA / "kitti_object"):
        xyz = frame.load().xyz
        for car in frame.truth().select_class(CLASSES.index("Car")):
            inside = xyz[points_in_box(xyz, car)]
            for shape, result in errors.items() if len(inside) >= 30 else ():
                yaw = apply_to_one(fit_boxes, inside, shape)[6]
                result.append(np.degrees(compute_angle(yaw, car[6], np.pi / 2)))
    assert len(errors["l_shape"]) > 100
    assert np.median(errors["l_shape"]) < 1 and np.percentile(errors["l_shape"], 90) < 6
    assert np.mean(errors["l_shape"]) < np.mean(errors["min_area"])
