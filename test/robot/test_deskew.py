"""Motion correction: an inverse, the same as a plain loop, and bounded work."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lidar_perception.robot.deskew import MOMENTS, deskewed, skewed, steady

numbers = st.floats(-1, 1, allow_subnormal=False)


def turn(count=2000, seed=0):
    """Points and the seconds they are measured at."""
    rng = np.random.default_rng(seed)
    return (rng.uniform(-60, 60, (count, 3)).astype(np.float32),
            rng.uniform(-0.05, 0.05, count))


@given(st.tuples(numbers, numbers, numbers), st.tuples(numbers, numbers, numbers))
def test_what_a_moving_sensor_reports_is_put_right(velocity, rotation):
    xyz, seconds = turn(200)
    poses = steady(np.array(velocity) * 30, np.array(rotation) * 2)
    np.testing.assert_allclose(deskewed(skewed(xyz, seconds, poses), seconds, poses), xyz,
                               atol=1e-4)


def test_it_is_what_a_loop_over_the_points_gives():
    xyz, seconds = turn()
    velocity, rotation = np.array([15.0, 0.3, -0.2]), np.array([0.02, -0.1, 0.7])
    steps = 400  # the way on the arc, in small straight pieces
    expected = []
    for point, t in zip(xyz[:40].astype(float), seconds):
        pose, place = Rotation.identity(), np.zeros(3)
        for _ in range(steps):
            middle = pose * Rotation.from_rotvec(rotation * t / steps / 2)
            place = place + middle.apply(velocity * t / steps)
            pose = pose * Rotation.from_rotvec(rotation * t / steps)
        expected.append(pose.apply(point) + place)
    found = deskewed(xyz, seconds, steady(velocity, rotation))
    np.testing.assert_allclose(found[:40], expected, atol=3e-3)  # MOMENTS: 15 m/s for 12 us
    assert np.abs(np.array(expected) - xyz[:40]).max() > 0.5


def test_a_sensor_that_stands_still_changes_no_bit_wherever_it_stands():
    xyz, seconds = turn()
    place = np.tile(np.eye(4), (1, 1, 1))
    place[0, :3, :3] = Rotation.from_rotvec([0.3, 1.0, -2.0]).as_matrix()
    place[0, :3, 3] = 4e5, -3e4, 100.0
    found = deskewed(xyz, seconds, lambda at: np.repeat(place, len(at), axis=0))
    np.testing.assert_allclose(found, xyz, atol=1e-5)
    np.testing.assert_array_equal(deskewed(xyz, seconds, steady(np.zeros(3), np.zeros(3))), xyz)
    poses = steady([20.0, 0, 0], [0, 0, 1.0])
    np.testing.assert_array_equal(deskewed(xyz, np.zeros(len(xyz)), poses), xyz)
    assert deskewed(xyz[:0], seconds[:0], poses).shape == (0, 3)


@pytest.mark.parametrize("count", [10, 100_000])
def test_poses_are_asked_for_once_and_few_times(count):
    xyz, seconds = turn(count)
    asked = []

    def poses(at):
        asked.append(len(at))
        return np.tile(np.eye(4), (len(at), 1, 1))
    deskewed(xyz, seconds, poses)
    assert asked == [MOMENTS + 1]


def test_the_twist_of_a_car_takes_it_round_a_circle():
    """At 10 m/s and 0.5 rad/s it drives a circle of 20 m."""
    at = np.linspace(-1, 1, 21)
    poses = steady([10.0, 0, 0], [0, 0, 0.5])(at)
    np.testing.assert_allclose(np.hypot(poses[:, 0, 3], poses[:, 1, 3] - 20.0), 20.0, atol=1e-9)
    np.testing.assert_allclose(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]), at * 0.5, atol=1e-9)
