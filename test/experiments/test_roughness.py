"""Properties of the measured ground roughness."""

import numpy as np
import pytest

from experiments.realism.roughness import MIN_CELLS, compute_roughness, measure_cell_scatter

LIMITS = np.array([0.0, 5.0, 15.0, np.inf])


def make_plane(seed, count=8000, slopes=(0.0, 0.0), noise=0.0):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-12, 12, (count, 2))
    return np.column_stack([xy, xy @ slopes - 1.7 + rng.normal(0, noise, count)])


@pytest.mark.parametrize("slopes", [(0.0, 0.0), (0.1, -0.05)])
def test_plane_is_smooth_at_any_slope(slopes):
    middle, scatter = measure_cell_scatter(make_plane(0, slopes=slopes))
    assert len(middle) > 400 and scatter.max() < 1e-4


def test_scatter_equals_the_noise_of_the_points():
    _, scatter = measure_cell_scatter(make_plane(1, 40_000, (0.05, 0.0), 0.03))
    assert np.sqrt((scatter**2).mean()) == pytest.approx(0.03, rel=0.04)


def test_points_on_a_line_have_no_scatter():
    y = np.linspace(-10, 10, 1000)
    line = np.column_stack([np.full(1000, 8.3), y, 0.02 * y])
    assert measure_cell_scatter(line)[1].max() < 1e-3


def test_cells_with_objects_are_not_ground():
    ground = make_plane(2)
    post = np.column_stack([np.full(200, 4.5), np.full(200, 4.5), np.linspace(-1.7, 0.3, 200)])
    few = np.column_stack([np.full(2, -4.5), np.full(2, 4.5), [0.5, 1.0]])
    ground_scatter, _ = measure_cell_scatter(ground)
    middle, scatter = measure_cell_scatter(np.concatenate([ground, post, few]))
    assert len(middle) == len(ground_scatter) - 1 and scatter.max() < 1e-4


def test_order_and_height_offset_do_not_matter():
    xyz = make_plane(3, noise=0.02)
    expected = compute_roughness(xyz, LIMITS)
    shuffled = np.random.default_rng(0).permutation(xyz) + [0.0, 0.0, 5.0]
    np.testing.assert_allclose(compute_roughness(shuffled, LIMITS), expected, atol=1e-9)


@pytest.mark.parametrize("count", [0, 1, 7])
def test_too_few_points_have_no_roughness(count):
    assert np.isnan(compute_roughness(np.zeros((count, 3), np.float32), LIMITS)).all()
    assert len(measure_cell_scatter(np.zeros((count, 3)))[0]) == 0


def test_range_bin_needs_enough_cells():
    few = make_plane(4)
    few = few[np.hypot(few[:, 0], few[:, 1]) < 5]
    row = compute_roughness(few, np.array([0.0, 5.0, 15.0]))
    assert MIN_CELLS < 60 and row[0] < 1e-4 and np.isnan(row[1])
