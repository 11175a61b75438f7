"""Silhouettes (STM and CPA), compared with a plain implementation that uses OpenCV."""

from __future__ import annotations

import numpy as np
import pytest
from candidate_samples import from_pixels
from hypothesis import example, given
from hypothesis import strategies as st
from samples import DATA, needs_data

from lidar_perception.candidates.params import CpaParams
from lidar_perception.candidates.pipeline import segment_cloud
from lidar_perception.candidates.silhouette import (
    COLUMNS,
    ROWS,
    compute_cpa_scales,
    compute_similarity,
    draw_silhouettes,
    to_pixels,
)
from lidar_perception.types import PointCloud

SCANS = DATA / "kitti_object/training/velodyne_reduced"
seeds = st.integers(0, 2**32 - 1)


def draw_silhouette(xyz, scales=(1.0,)):
    return draw_silhouettes(xyz, np.array([0, len(xyz)]), np.array([scales]))[0]


def draw_plainly(xyz, scales=(1.0,)):
    """Return (80, 32) bool, drawn step by step as in Sections 3.6 and 3.7."""
    points = np.asarray(xyz, np.float64)
    centre = points.mean(axis=0)
    _, vectors = np.linalg.eigh(np.cov((points - centre)[:, :2].T, bias=True))
    lateral = vectors[:, -1]
    left = np.array([-centre[1], centre[0]])  # left and right as seen from the sensor
    lateral = lateral if lateral @ left >= 0 else -lateral
    cluster = np.column_stack([(points - centre)[:, :2] @ lateral, points[:, 2] - centre[2]])
    augmented = np.concatenate([a * cluster for a in scales])  # contracted to the centroid
    (y0, z0), (y1, z1) = augmented.min(axis=0), augmented.max(axis=0)
    column = np.floor((augmented[:, 0] - y0) / max(y1 - y0, 1e-6) * COLUMNS)
    row = np.floor((z1 - augmented[:, 1]) / max(z1 - z0, 1e-6) * ROWS)
    image = np.zeros((ROWS, COLUMNS), np.uint8)
    image[np.minimum(row, ROWS - 1).astype(int), np.minimum(column, COLUMNS - 1).astype(int)] = 1
    cv2 = pytest.importorskip("cv2", reason="needs OpenCV, an independent closing and dilation")
    kernel = np.ones((3, 3), np.uint8)
    return cv2.dilate(cv2.morphologyEx(image, cv2.MORPH_CLOSE, kernel), kernel).astype(bool)


def make_cluster(rng, count=None):
    """Return a random elongated cluster 3 to 40 m from the sensor."""
    count = count or rng.integers(5, 400)
    shape = rng.normal(size=(count, 3)) * [0.1, 0.3, 0.6] * rng.uniform(0.5, 2)
    bearing = rng.uniform(-np.pi, np.pi)
    return rotate(shape + [rng.uniform(3, 40), 0, rng.uniform(-2, 1)], bearing, rng)


def rotate(xyz, angle, rng=None):
    """Rotate points about the sensor's z axis; with rng, first about their own centre."""
    if rng is not None:
        centre = xyz.mean(axis=0) * [1, 1, 0]
        xyz = rotate(xyz - centre, rng.uniform(-np.pi, np.pi)) + centre
    cos, sin = np.cos(angle), np.sin(angle)
    return (xyz @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])).astype(np.float32)


@given(seeds)
def test_silhouettes_of_random_clusters_equal_the_reference(seed):
    rng = np.random.default_rng(seed)
    clusters = [make_cluster(rng) for _ in range(4)]
    scales = np.column_stack([np.ones(4), rng.uniform(0, 1, (4, 3))])
    scales[rng.random((4, 4)) < 0.3] = 1.0
    start = np.cumsum([0] + [len(c) for c in clusters])
    images = draw_silhouettes(np.concatenate(clusters), start, scales)
    assert images.shape == (4, ROWS) and images.dtype == np.uint32
    for image, points, factors in zip(images, clusters, scales):
        np.testing.assert_array_equal(to_pixels(image), draw_plainly(points, factors))


@needs_data
def test_silhouettes_of_real_clusters_equal_the_reference():
    values = np.fromfile(sorted(SCANS.glob("*.bin"))[4], np.float32).reshape(-1, 4)
    segmented = segment_cloud(PointCloud(np.ascontiguousarray(values[:, :3])))
    ids = range(1, segmented.cluster_ids.max() + 1)
    assert len(ids) > 20
    for points in (segmented.xyz[segmented.cluster_ids == k] for k in ids):
        for scales in ((1.0,), (1.0, 0.9, 0.8)):
            np.testing.assert_array_equal(to_pixels(draw_silhouette(points, scales)), draw_plainly(points, scales))


def test_window_fits_the_cluster_and_row_0_is_its_top():
    # An L as seen from the sensor: upright on the left, foot to the right.
    upright = np.column_stack([np.full(60, 9.0), np.full(60, 0.5), np.linspace(0, 1.8, 60)])
    foot = np.column_stack([np.full(60, 9.0), np.linspace(-0.5, 0.5, 60), np.zeros(60)])
    pixels = to_pixels(draw_silhouette(np.concatenate([upright, foot]).astype(np.float32)))
    left = 31  # left of the sensor is the highest y
    assert pixels[:, left].all() and pixels[-1].all()
    assert not pixels[:70, :28].any()


@given(seeds)
def test_to_pixels_and_from_pixels_are_inverse(seed):
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 2**32, ROWS, dtype=np.uint32)
    pixels = rng.random((ROWS, COLUMNS)) < rng.random()
    np.testing.assert_array_equal(from_pixels(to_pixels(image)), image)
    np.testing.assert_array_equal(to_pixels(from_pixels(pixels)), pixels)
    assert from_pixels(pixels).dtype == np.uint32 and to_pixels(image).dtype == bool


@given(seeds)
@example(40877)  # contains a blank image
def test_similarity_is_the_cosine_of_flattened_images(seed):
    rng = np.random.default_rng(seed)
    pixels = rng.random((5, ROWS, COLUMNS)) < rng.random((5, 1, 1))
    images = np.stack([from_pixels(p) for p in pixels])
    vectors = pixels.reshape(5, -1).astype(float)
    norms = np.linalg.norm(vectors, axis=1) * np.linalg.norm(vectors[0])
    expected = vectors @ vectors[0] / np.where(norms > 0, norms, 1.0)  # 0 for a blank image
    np.testing.assert_allclose(compute_similarity(images, images[0]), expected, rtol=0, atol=1e-12)


@given(seeds)
def test_similarity_is_symmetric_and_exactly_1_with_itself(seed):
    rng = np.random.default_rng(seed)
    images = np.stack([draw_silhouette(make_cluster(rng)) for _ in range(3)])
    table = np.stack([compute_similarity(images, image) for image in images])
    assert (np.diag(table) == 1.0).all()  # so that the seed itself passes a threshold of 1
    np.testing.assert_array_equal(table, table.T)
    assert (table >= 0).all() and (table <= 1).all()


def test_similarity_with_a_blank_image_is_0():
    blank, full = np.zeros(ROWS, np.uint32), np.full(ROWS, 2**32 - 1, np.uint32)
    assert compute_similarity(np.stack([blank, full]), blank).tolist() == [0, 0]
    assert compute_similarity(np.stack([blank, full]), full).tolist() == [0, 1]
    assert compute_similarity(np.zeros((0, ROWS), np.uint32), full).shape == (0,)


@given(seeds, st.integers(0, 9))
def test_augmentation_only_adds_pixels(seed, steps):
    # Closing and dilation are monotonic, so a subset stays a subset.
    xyz = make_cluster(np.random.default_rng(seed))
    scales = compute_cpa_scales(np.array([20.0]), CpaParams(steps=steps))[0]
    original, augmented = to_pixels(draw_silhouette(xyz)), to_pixels(draw_silhouette(xyz, scales))
    assert (augmented >= original).all()
    if steps == 0:
        np.testing.assert_array_equal(augmented, original)


def test_augmentation_scales_match_the_paper():
    ranges = np.array([0, 14.999, 15, 22, 29.999, 30, 31, 1e5])
    in_range = [False, False, True, True, True, False, False, False]
    scales = compute_cpa_scales(ranges, CpaParams())
    assert scales.shape == (8, 3) and scales.dtype == np.float64
    np.testing.assert_allclose(scales[in_range], [[1.0, 0.9, 0.8]] * 3, rtol=0, atol=1e-12)
    assert (scales[np.logical_not(in_range)] == 1).all()


def test_scale_decreases_in_steps_down_to_min_scale():
    scales = compute_cpa_scales(np.array([20.0]), CpaParams(steps=11))[0]
    np.testing.assert_allclose(scales, [1, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.2, 0.2, 0.2], rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        compute_cpa_scales(np.array([20.0]), CpaParams(steps=3, decrement=0.4, min_scale=0.0))[0],
        [1, 0.6, 0.2, 0.0],
        rtol=0,
        atol=1e-12,
    )


def test_zero_steps_or_clusters_give_empty_arrays():
    np.testing.assert_array_equal(compute_cpa_scales(np.array([5.0, 20.0]), CpaParams(steps=0)), np.ones((2, 1)))
    assert compute_cpa_scales(np.zeros(0), CpaParams()).shape == (0, 3)
    images = draw_silhouettes(np.zeros((0, 3), np.float32), np.array([0]), np.ones((0, 3)))
    assert images.shape == (0, ROWS) and images.dtype == np.uint32


@pytest.mark.parametrize("at", [[8, 1, -1], [0, 0, 1], [0.3, -70, -1.2], [-7e4, 7e4, 3]])
@pytest.mark.parametrize("scales", [(1.0,), (1.0, 0.9, 0.8), (1.0, 0.0)])
def test_coincident_points_set_the_top_left_pixel(at, scales):
    # A point without extent falls into the first pixel of the window.
    for count in (1, 2, 7, 100):
        pixels = to_pixels(draw_silhouette(np.full((count, 3), at, np.float32), scales))
        assert pixels[:2, :2].all() and pixels.sum() == 4


def test_input_is_not_modified():
    xyz = make_cluster(np.random.default_rng(0), 50)
    original, scales = xyz.copy(), np.array([[1.0, 0.9]])
    draw_silhouettes(xyz, np.array([0, 50]), scales)
    np.testing.assert_array_equal(xyz, original)
    assert scales.tolist() == [[1.0, 0.9]]
