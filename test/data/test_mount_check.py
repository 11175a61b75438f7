"""Height and tilt of a sensor, measured from its clouds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ground_samples import make_street

from lidar_perception.data.frame import Recording
from lidar_perception.data.mount_check import find_height_problem, find_mount_problem, measure_sensor_height
from lidar_perception.ground.params import SensorPoseParams
from lidar_perception.ground.segment import level_points
from lidar_perception.types import PointCloud


@pytest.mark.parametrize("height", [0.4, 1.73, 3.0])
def test_sensor_height_is_measured(height):
    xyz, _ = make_street(5, slope=(0.02, -0.01))
    xyz[:, 2] += np.float32(1.73 - height)
    found = measure_sensor_height(xyz)
    assert abs(found - height) < 0.03
    assert (find_height_problem(found, SensorPoseParams()) is None) == (height == 1.73)
    assert find_height_problem(found, SensorPoseParams(height=height)) is None
    assert abs(measure_sensor_height(xyz * np.float32([1, -1, -1])) + height) < 0.03


def test_dense_vehicle_is_not_taken_for_the_ground():
    xyz, _ = make_street(5, slope=(0.0, 0.03))
    roof = np.random.default_rng(0).uniform((-3, 2.6, -0.35), (3, 4.4, -0.3), (10 * len(xyz), 3)).astype(np.float32)
    assert abs(measure_sensor_height(np.concatenate([xyz, roof])) - 1.73) < 0.05


@pytest.mark.parametrize("lean", [0, 3, 8, -20])
def test_tilted_sensor_of_a_recording_is_reported(lean):
    pose = SensorPoseParams(pitch=np.radians(lean))
    clouds = [PointCloud.of(level_points(make_street(i)[0], pose)) for i in range(3)]
    recording = Recording(Path("drive.bag"), "bag", [])
    problem = find_mount_problem(recording, clouds)
    assert (problem is not None) == (abs(lean) > 5)
    if problem is not None:
        assert f"by {abs(lean)} degrees" in problem and "drive.bag --robot" in problem
    flipped = [PointCloud(cloud.xyz * np.float32([1, -1, -1])) for cloud in clouds]
    assert "upside down" in find_mount_problem(recording, flipped)
    assert find_mount_problem(recording, [PointCloud.of(np.zeros((0, 3)))]) is None
    assert find_mount_problem(recording, []) is None


def test_table_above_the_sensor_is_not_taken_for_the_floor():
    rng = np.random.default_rng(0)
    table = rng.uniform((-6, -6, 0.28), (6, 6, 0.32), (3000, 3))
    room = rng.uniform((-9, -9, 0.4), (9, 9, 2.2), (3000, 3))
    assert abs(measure_sensor_height(table.astype(np.float32)) + 0.3) < 0.02
    assert measure_sensor_height(np.concatenate([table, room]).astype(np.float32)) is None


def test_wrong_height_is_reported_with_remedy():
    assert "set it to 0.60" in find_height_problem(0.6, SensorPoseParams())
    assert "upside down" in find_height_problem(-1.7, SensorPoseParams())
    assert find_height_problem(None, SensorPoseParams()) is None


def test_height_is_unknown_without_a_plane():
    wall = np.random.default_rng(0).uniform(-9, 9, (5000, 3)) * [0, 1, 1] + [9, 0, 0]
    for xyz in (np.zeros((0, 3)), np.ones((1, 3)), wall, np.full((100, 3), 9.0)):
        assert measure_sensor_height(xyz.astype(np.float32)) is None
    ball = np.random.default_rng(1).normal(0, 8, (5000, 3))
    assert measure_sensor_height(ball.astype(np.float32)) is None
