"""TF and odometry of a bag, compared with the clouds."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import yaml
from robot_bags import (
    ON_BASE,
    START,
    compute_base_pose,
    make_mount_rows,
    make_odometry_rows,
    make_tf_message,
    make_tf_rows,
    make_transform,
    write_robot_bag,
)

from lidar_perception.data.raw_clouds import _to_message, open_clouds
from lidar_perception.params import ReceptionParams
from lidar_perception.robot.placement import make_tilted_pose
from lidar_perception.robot.poses import invert_pose
from lidar_perception.sensor_setup.measurement.measure import measure_sensor
from lidar_perception.sensor_setup.measurement.motion import compute_shifts, estimate_heading
from lidar_perception.sensor_setup.measurement.recorded_poses import RecordedPoses, read_recorded_poses
from lidar_perception.sensor_setup.measurement.scans import read_scan
from lidar_perception.sensor_setup.report.files import format_params
from lidar_perception.sensor_setup.report.params import choose_params
from lidar_perception.sensor_setup.report.values import list_values
from lidar_perception.sensor_setup.report.warnings import find_warnings
from lidar_perception.simulation.recording import simulate_frames
from lidar_perception.simulation.scene import Scenes
from lidar_perception.simulation.sensor import find_sensor
from lidar_perception.wire.topics import ODOMETRY, TF_STATIC
from lidar_perception.wire.transforms import TF_MESSAGE

COUNT, HEIGHT = 8, 1.7


@cache
def simulate_drive():
    """Return scans and poses of a sensor that drives ahead at a car's speed."""
    frames = list(simulate_frames(502, COUNT, find_sensor("vlp-16"), 40, Scenes(scene="street")))
    return [read_scan(_to_message(frame)) for frame in frames], [frame.pose() for frame in frames]


def make_mount(yaw, roll=0.0, pitch=0.0):
    """Return the pose (4, 4) of the sensor in the base."""
    a = np.radians(yaw)
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
    pose = turn @ make_tilted_pose(np.radians(roll), np.radians(pitch))
    pose[:3, 3] = 0.3, -0.1, 1.2
    return pose


def measure_drive(recorded, backwards=False):
    scans, _ = simulate_drive()
    return measure_sensor(scans[::-1] if backwards else scans, range(COUNT), "drive", COUNT, None, recorded)


def make_recorded_poses(poses, actual, mount=None, height=None):
    """Return recorded poses of a robot whose sensor is at `actual`, while TF says `mount`."""
    footprint = None if height is None else make_tilted_pose(0, 0, height)
    return RecordedPoses("base_link", mount, footprint, {i: pose @ invert_pose(actual) for i, pose in enumerate(poses)})


@pytest.mark.parametrize("yaw", [0, pytest.param(-150, marks=pytest.mark.no_cover)])
def test_heading_is_the_x_axis_of_the_base_even_when_reversing(yaw):
    """The sensor's x is at yaw in the base, so the base's x is at -yaw in the sensor."""
    _, poses = simulate_drive()
    mount = make_mount(yaw)
    for backwards in (False, True):
        m = measure_drive(make_recorded_poses(poses[::-1] if backwards else poses, mount, mount), backwards)
        heading = m.mounting.heading
        assert heading.from_base and abs((heading.degrees + yaw + 180) % 360 - 180) < 3
        assert not any("by TF, x of" in line for line in find_warnings(m))
        ahead = choose_params(m).get("input.ahead", (0.0,))[0]
        assert abs((ahead + yaw + 180) % 360 - 180) < 3
    if not yaw:
        # without odometry it seems to drive backwards
        heading = measure_drive(RecordedPoses(), backwards=True).mounting.heading
        assert abs(abs(heading.degrees) - 180) < 3
    written = yaml.safe_load(format_params(m))["/**"]["ros__parameters"]["input"]
    assert written.pop("ahead", 0.0) == ahead
    assert ReceptionParams(ahead=ahead) and not written.keys() - {"intensity_max"}


def test_driving_back_and_forth_needs_odometry():
    shifts = {(i, i + 1): (-1) ** i * np.array([2.0, 0.5]) for i in range(8)}
    went = {pair: (-1) ** pair[0] * np.array([0.5, -2.0]) for pair in shifts}
    assert "back and forth" in estimate_heading(shifts, {}).problem
    assert estimate_heading(shifts, went).degrees == pytest.approx(90)
    off = {pair: (np.cos(i), np.sin(i)) for i, pair in enumerate(shifts)}
    assert "does not agree" in estimate_heading(shifts, off).problem


def test_odometry_of_sensor_shows_its_heading():
    _, poses = simulate_drive()
    m = measure_drive(RecordedPoses(poses={i: pose @ make_mount(30) for i, pose in enumerate(poses)}))
    heading = m.mounting.heading
    assert heading.degrees == pytest.approx(-30, abs=1) and not heading.from_base


def test_single_pose_does_not_mean_a_stationary_robot():
    _, poses = simulate_drive()
    m = measure_drive(RecordedPoses("base_link", poses={COUNT - 1: poses[-1]}))
    assert m.view.coverage.stationary is False
    assert not any("stands still" in line for line in find_warnings(m))


def test_heading_error_is_at_least_7_degrees_from_one_place():
    heading = estimate_heading({(i, i + 1): np.array([1.0, 0.25]) for i in range(40)}, {})
    assert heading.error >= 7 and not heading.is_off_axis


def test_shifts_need_poses_and_straight_motion():
    rotated_pose = make_mount(10) @ invert_pose(make_mount(0))
    poses = {0: np.eye(4), 1: np.eye(4), 2: rotated_pose}
    steps = compute_shifts(poses, dict.fromkeys([(0, 1), (0, 2), (0, 7)]))
    assert steps == {(0, 1): (0, 0), (0, 2): None}


def test_contradiction_between_tf_and_clouds_is_reported():
    _, poses = simulate_drive()
    m = measure_drive(RecordedPoses())
    mount = m.mounting.mount
    roll, pitch = np.degrees([mount.roll, mount.pitch])
    true = make_mount(0, roll, pitch)
    right = measure_drive(make_recorded_poses(poses, true, true, mount.height + 0.05))
    row = next(value for value in list_values(right) if value.name == "mount by TF")
    assert row.confidence == "high"
    assert not any("URDF" in line for line in find_warnings(right))
    incomplete_poses = right.mounting.recorded._replace(problem="3 of 4 clouds have no pose")
    unposed = replace(right, mounting=right.mounting._replace(recorded=incomplete_poses))
    assert any("only from clouds: 3 of 4 clouds" in line for line in find_warnings(unposed))
    for tf_mount, height, words in (
        (make_mount(0, roll + 3, pitch), None, "has roll"),
        (make_mount(0, roll, pitch - 3), None, "and pitch"),
        (make_mount(45, roll, pitch), None, "correct the yaw"),
        (true, mount.height + 0.4, "above the ground"),
    ):
        wrong = measure_drive(make_recorded_poses(poses, true, tf_mount, height))
        assert sum("URDF" in line and words in line for line in find_warnings(wrong)) == 1
        row = next(value for value in list_values(wrong) if value.name == "mount by TF")
        assert row.confidence == "low"


def test_mount_and_poses_are_read_from_bag(tmp_path):
    write_robot_bag(
        tmp_path / "bag", make_odometry_rows(ODOMETRY), make_mount_rows("base_footprint", np.eye(4)), make_mount_rows()
    )
    clouds = open_clouds(tmp_path / "bag")
    found = read_recorded_poses(clouds.poses, range(3), clouds.stamps_ns)
    assert found.base == "base_link" and found.heading == pytest.approx(-90, abs=0.2)
    np.testing.assert_allclose(found.mount, ON_BASE, atol=1e-6)
    for i, pose in found.poses.items():
        np.testing.assert_allclose(pose, compute_base_pose(int(clouds.stamps_ns[i])), atol=1e-4)
    assert len(found.poses) == 3 and np.isnan(found.height)
    # A static map frame above the moving ones is not the robot.
    world = TF_STATIC, TF_MESSAGE, START, make_tf_message(make_transform("world", "map", 0, np.eye(4)))
    write_robot_bag(tmp_path / "tf", make_tf_rows(), make_mount_rows(), [world])
    clouds = open_clouds(tmp_path / "tf")
    assert read_recorded_poses(clouds.poses, range(3), clouds.stamps_ns).base == "base_link"
    # Odometry without child_frame_id does not count as that of the base.
    write_robot_bag(tmp_path / "of", make_odometry_rows(ODOMETRY, ""), make_mount_rows())
    clouds = open_clouds(tmp_path / "of")
    nameless = read_recorded_poses(clouds.poses, range(3), clouds.stamps_ns)
    assert nameless.base == "base_link" and nameless.poses == {}
    assert "child_frame_id" in nameless.problem
    write_robot_bag(tmp_path / "bare", make_odometry_rows(ODOMETRY, ""))
    clouds = open_clouds(tmp_path / "bare")
    assert read_recorded_poses(clouds.poses, range(3), clouds.stamps_ns) == RecordedPoses(problem=nameless.problem)
    # Odometry with another clock has no poses at the times of the clouds.
    write_robot_bag(tmp_path / "clock", make_odometry_rows(ODOMETRY), make_mount_rows())
    clouds = open_clouds(tmp_path / "clock")
    assert read_recorded_poses(clouds.poses, range(3), clouds.stamps_ns).problem == ""
    apart = read_recorded_poses(clouds.poses, range(3), clouds.stamps_ns - 10**12)
    assert apart.poses == {} and apart.problem.startswith("3 of 3 clouds have no pose")
    write_robot_bag(tmp_path / "stands", make_mount_rows())
    clouds = open_clouds(tmp_path / "stands")
    fixed = read_recorded_poses(clouds.poses, range(3), clouds.stamps_ns)
    assert fixed.base == "base_link" and fixed.problem == ""
    write_robot_bag(tmp_path / "none")
    clouds = open_clouds(tmp_path / "none")
    assert read_recorded_poses(clouds.poses, range(3), clouds.stamps_ns) == RecordedPoses()
