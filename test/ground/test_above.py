"""Heights above the ground around, and what is an obstacle by them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidar_perception.ground.above import CELL, height_above, obstacles
from lidar_perception.ground.params import ObstacleParams, SensorPoseParams
from lidar_perception.ground.segment import level


def cloud(rng, count, reach=20.0):
    return rng.uniform(-reach, reach, (count, 3)).astype(np.float32)


def plain_heights(xyz, ground):
    """The same, cell by cell and point by point; all of them where cells are equally near."""
    cells: dict[tuple, list] = {}
    for x, y, z in ground.astype(float):
        cells.setdefault((np.floor(x / CELL), np.floor(y / CELL)), []).append(z)
    centres = (np.array(list(cells)) + 0.5) * CELL
    means = np.array([np.mean(z) for z in cells.values()])
    for x, y, z in xyz.astype(float):
        square = ((centres - (x, y)) ** 2).sum(axis=1)
        yield z - means[square <= square.min() + 1e-9]


@given(st.integers(0, 10_000), st.integers(1, 300), st.floats(1.0, 1e5))
def test_it_is_the_height_above_the_nearest_cell_of_ground(seed, count, reach):
    rng = np.random.default_rng(seed)
    xyz, ground = cloud(rng, 50), cloud(rng, count)
    far = np.float32([reach, -reach, 0])
    for found, heights in zip(height_above(xyz + far, ground + far),
                              plain_heights(xyz + far, ground + far), strict=True):
        assert np.abs(heights - found).min() <= 1e-9


@given(st.integers(0, 10_000), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_on_a_slope_it_errs_by_no_more_than_a_cell_climbs(seed, a, b):
    """A full cell's mean lies within its lowest and highest point."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-5, 5, (4000, 2))
    ground = np.column_stack([xy, xy @ [a, b] - 1.73])
    high = rng.uniform(0, 3, len(xy))
    found = height_above(ground + np.column_stack([0 * xy, high]), ground)
    assert np.abs(found - high).max() <= CELL * (abs(a) + abs(b)) + 1e-9


def test_obstacles_are_what_is_no_ground_within_the_band_whatever_the_order():
    rng = np.random.default_rng(0)
    xyz, ground = cloud(rng, 3000), rng.random(3000) < 0.4
    np.testing.assert_array_equal(obstacles(xyz, ground), ~ground)
    height = np.full(len(xyz), np.nan)
    height[~ground] = height_above(xyz[~ground], xyz[ground])
    for low, high in ((0.2, 0), (0, 5), (0.2, 5)):
        found = obstacles(xyz, ground, ObstacleParams(low, high))
        expected = (height >= (low or -np.inf)) & (height <= (high or np.inf))
        np.testing.assert_array_equal(found, expected)
        order = rng.permutation(len(xyz))
        np.testing.assert_array_equal(
            obstacles(xyz[order], ground[order], ObstacleParams(low, high)), found[order])


def test_a_tilted_sensor_finds_the_same_obstacles():
    rng = np.random.default_rng(1)
    xyz, ground = cloud(rng, 2000), rng.random(2000) < 0.5
    tilted = SensorPoseParams(roll=0.2, pitch=-0.3)
    turn = level(np.eye(3, dtype=np.float32), tilted)  # rows: where the axes go
    seen = (xyz.astype(float) @ np.linalg.inv(turn.astype(float))).astype(np.float32)
    band = ObstacleParams(0.3, 4.0)
    same = obstacles(seen, ground, band, tilted) == obstacles(xyz, ground, band)
    assert same.mean() > 0.998  # rounding moves a point into the next cell


def test_without_ground_all_is_an_obstacle_and_without_points_nothing():
    xyz = cloud(np.random.default_rng(2), 10)
    assert obstacles(xyz, np.zeros(10, bool), ObstacleParams(0.2, 2.0)).all()
    assert not obstacles(xyz, np.ones(10, bool), ObstacleParams(0.2, 2.0)).any()
    assert obstacles(xyz[:0], np.zeros(0, bool), ObstacleParams(0.2, 2.0)).shape == (0,)


def test_a_band_that_holds_nothing_is_refused():
    with pytest.raises(ValueError, match="must not be below min_height"):
        ObstacleParams(min_height=2.0, max_height=1.0)
