"""Motion correction inverts skew, equals a plain loop, and looks up few poses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from motion_samples import make_constant_motion, skew
from scipy.spatial.transform import Rotation

from lidar_perception.robot.deskew import MAX_POSES, deskew

numbers = st.floats(-1, 1, allow_subnormal=False)


def make_sweep(count=2000, seed=0):
    """Return points (N, 3), and the time of each in seconds after the stamp."""
    rng = np.random.default_rng(seed)
    return (rng.uniform(-60, 60, (count, 3)).astype(np.float32), rng.uniform(-0.05, 0.05, count))


@given(st.tuples(numbers, numbers, numbers), st.tuples(numbers, numbers, numbers))
def test_deskew_inverts_skew(velocity, rotation):
    xyz, seconds = make_sweep(200)
    poses = make_constant_motion(np.array(velocity) * 30, np.array(rotation) * 2)
    np.testing.assert_allclose(deskew(skew(xyz, seconds, poses), seconds, poses), xyz, atol=1e-4)


def test_deskew_equals_loop_over_points():
    xyz, seconds = make_sweep()
    velocity, rotation = np.array([15.0, 0.3, -0.2]), np.array([0.02, -0.1, 0.7])
    steps = 400  # integrate the arc in small straight steps
    expected = []
    for point, t in zip(xyz[:40].astype(float), seconds):
        attitude, position = Rotation.identity(), np.zeros(3)
        for _ in range(steps):
            middle = attitude * Rotation.from_rotvec(rotation * t / steps / 2)
            position = position + middle.apply(velocity * t / steps)
            attitude = attitude * Rotation.from_rotvec(rotation * t / steps)
        expected.append(attitude.apply(point) + position)
    result = deskew(xyz, seconds, make_constant_motion(velocity, rotation))
    np.testing.assert_allclose(result[:40], expected, atol=3e-3)  # at most MAX_POSES poses per sweep
    assert np.abs(np.array(expected) - xyz[:40]).max() > 0.5


def test_points_of_a_static_sensor_are_not_moved():
    xyz, seconds = make_sweep()
    pose = np.tile(np.eye(4), (1, 1, 1))
    pose[0, :3, :3] = Rotation.from_rotvec([0.3, 1.0, -2.0]).as_matrix()
    pose[0, :3, 3] = 4e5, -3e4, 100.0
    result = deskew(xyz, seconds, lambda at: np.repeat(pose, len(at), axis=0))
    np.testing.assert_allclose(result, xyz, atol=1e-5)
    np.testing.assert_array_equal(deskew(xyz, seconds, make_constant_motion(np.zeros(3), np.zeros(3))), xyz)
    poses = make_constant_motion([20.0, 0, 0], [0, 0, 1.0])
    np.testing.assert_array_equal(deskew(xyz, np.zeros(len(xyz)), poses), xyz)
    assert deskew(xyz[:0], seconds[:0], poses).shape == (0, 3)


@pytest.mark.parametrize("count", [10, 100_000])
def test_poses_are_looked_up_once_for_few_distinct_times(count):
    xyz, seconds = make_sweep(count)
    calls = []

    def poses(at):
        calls.append(len(at))
        return np.tile(np.eye(4), (len(at), 1, 1))

    deskew(xyz, seconds, poses)
    assert calls == [MAX_POSES + 1]


def test_constant_speed_and_turn_rate_give_a_circle():
    """At 10 m/s and 0.5 rad/s, the radius is 20 m."""
    at = np.linspace(-1, 1, 21)
    poses = make_constant_motion([10.0, 0, 0], [0, 0, 0.5])(at)
    np.testing.assert_allclose(np.hypot(poses[:, 0, 3], poses[:, 1, 3] - 20.0), 20.0, atol=1e-9)
    np.testing.assert_allclose(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]), at * 0.5, atol=1e-9)
