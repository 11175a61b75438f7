"""Heights of points above the ground around them, and obstacles selected by height."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidar_perception.ground.obstacles import CELL_M, compute_height_above_ground, find_obstacles
from lidar_perception.ground.params import ObstacleParams, SensorPoseParams
from lidar_perception.ground.segment import level_points


def make_cloud(rng, count):
    return rng.uniform(-20.0, 20.0, (count, 3)).astype(np.float32)


def compute_heights_slowly(xyz, ground):
    """Yield, for each point, its heights above all nearest cells, if several are equally near."""
    cells: dict[tuple, list] = {}
    for x, y, z in ground.astype(float):
        cells.setdefault((np.floor(x / CELL_M), np.floor(y / CELL_M)), []).append(z)
    centres = (np.array(list(cells)) + 0.5) * CELL_M
    means = np.array([np.mean(z) for z in cells.values()])
    for x, y, z in xyz.astype(float):
        square = ((centres - (x, y)) ** 2).sum(axis=1)
        yield z - means[square <= square.min() + 1e-9]


@given(st.integers(0, 10_000), st.integers(1, 300), st.floats(1.0, 1e5))
def test_height_is_above_the_nearest_cell_with_ground(seed, count, reach):
    rng = np.random.default_rng(seed)
    xyz, ground = make_cloud(rng, 50), make_cloud(rng, count)
    far = np.float32([reach, -reach, 0])
    for result, heights in zip(
        compute_height_above_ground(xyz + far, ground + far),
        compute_heights_slowly(xyz + far, ground + far),
        strict=True,
    ):
        assert np.abs(heights - result).min() <= 1e-9


@given(st.integers(0, 10_000), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_error_on_a_slope_is_at_most_the_rise_of_a_cell(seed, a, b):
    """A cell's mean is between its lowest and its highest point."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-5, 5, (4000, 2))
    ground = np.column_stack([xy, xy @ [a, b] - 1.73])
    high = rng.uniform(0, 3, len(xy))
    result = compute_height_above_ground(ground + np.column_stack([0 * xy, high]), ground)
    assert np.abs(result - high).max() <= CELL_M * (abs(a) + abs(b)) + 1e-9


def test_obstacles_are_non_ground_points_within_the_band():
    rng = np.random.default_rng(0)
    xyz, ground = make_cloud(rng, 3000), rng.random(3000) < 0.4
    np.testing.assert_array_equal(find_obstacles(xyz, ground), ~ground)
    height = np.full(len(xyz), np.nan)
    height[~ground] = compute_height_above_ground(xyz[~ground], xyz[ground])
    for low, high in ((0.2, 0), (0, 5), (0.2, 5)):
        result = find_obstacles(xyz, ground, ObstacleParams(low, high))
        expected = (height >= (low or -np.inf)) & (height <= (high or np.inf))
        np.testing.assert_array_equal(result, expected)
        order = rng.permutation(len(xyz))
        np.testing.assert_array_equal(
            find_obstacles(xyz[order], ground[order], ObstacleParams(low, high)), result[order]
        )


def test_tilted_sensor_gives_the_same_obstacles():
    rng = np.random.default_rng(1)
    xyz, ground = make_cloud(rng, 2000), rng.random(2000) < 0.5
    tilted = SensorPoseParams(roll=0.2, pitch=-0.3)
    axes = level_points(np.eye(3, dtype=np.float32), tilted)  # rows: the levelled axes
    tilted_xyz = (xyz.astype(float) @ np.linalg.inv(axes.astype(float))).astype(np.float32)
    band = ObstacleParams(0.3, 4.0)
    same = find_obstacles(tilted_xyz, ground, band, tilted) == find_obstacles(xyz, ground, band)
    assert same.mean() > 0.998  # rounding moves some points into the next cell


def test_all_points_are_obstacles_without_ground():
    xyz = make_cloud(np.random.default_rng(2), 10)
    assert find_obstacles(xyz, np.zeros(10, bool), ObstacleParams(0.2, 2.0)).all()
    assert not find_obstacles(xyz, np.ones(10, bool), ObstacleParams(0.2, 2.0)).any()
    assert find_obstacles(xyz[:0], np.zeros(0, bool), ObstacleParams(0.2, 2.0)).shape == (0,)


def test_empty_height_band_is_rejected():
    with pytest.raises(ValueError, match="must not be below min_height"):
        ObstacleParams(min_height=2.0, max_height=1.0)
