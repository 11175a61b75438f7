"""The smooth surface through ground points."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from lidar_perception.ground.surface import CELL_M, MIN_POINTS, fit_ground_surface

SEEDS = st.integers(0, 2**32 - 1)


@given(SEEDS, st.floats(-0.25, 0.25), st.floats(-0.1, 0.1))
def test_surface_of_a_plane_is_the_plane(seed, along, across):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-40, 40, (40_000, 2))
    ground = np.column_stack([xy, xy @ [along, across] - 1.7])
    holes = np.hypot(*(xy - [5, 5]).T) > 2.0  # like the hole under a car
    places = np.concatenate([rng.uniform(-25, 25, (10, 2)), [[5, 5]]])
    heights = fit_ground_surface(ground[holes], 0.0).height_at(places)
    np.testing.assert_allclose(heights, places @ [along, across] - 1.7, atol=0.05)
    ground_points = rng.permutation(ground[holes])
    np.testing.assert_allclose(fit_ground_surface(ground_points, 0.0).height_at(places), heights, atol=1e-9)


@given(SEEDS, st.floats(-300, 300), st.floats(-300, 300))
def test_surface_shifts_with_the_points(seed, z, cells):
    rng = np.random.default_rng(seed)
    ground = rng.uniform([-20, -20, -2], [20, 20, -1], (3000, 3))
    shift = np.array([round(cells) * CELL_M, -round(cells) * CELL_M, z])
    places = rng.uniform(-50, 50, (20, 2))
    surface = fit_ground_surface(ground, 0.0)
    np.testing.assert_allclose(
        fit_ground_surface(ground + shift, 0.0).height_at(places + shift[:2]), surface.height_at(places) + z, atol=1e-6
    )
    heights = surface.height_at(places)
    assert heights.min() >= ground[:, 2].min() and heights.max() <= ground[:, 2].max()
    far = surface.height_at(places + [10_000, 0])
    np.testing.assert_allclose(far, surface.height_at(places + [20_000, 0]))


def test_surface_of_too_few_points_has_the_default_height():
    places = np.array([[0.0, 0.0], [50.0, -3.0]])
    for count in (0, MIN_POINTS - 1):
        surface = fit_ground_surface(np.zeros((count, 3)), -1.5)
        np.testing.assert_array_equal(surface.height_at(places), [-1.5, -1.5])
    one = fit_ground_surface(np.full((MIN_POINTS, 3), 0.5), -1.5)
    np.testing.assert_allclose(one.height_at(places), [0.5, 0.5])
    assert one.height_at(places[:0]).shape == (0,)
