"""What TF and odometry of a bag say is compared with what the clouds say."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import yaml
from robot_bags import ON_BASE, START, base_at, mount, moving, moving_tf, recorded, tf, transform

from lidar_perception.data.raw_clouds import _to_message, open_clouds
from lidar_perception.params import ReceptionParams
from lidar_perception.robot.placement import make_tilted_pose
from lidar_perception.robot.poses import invert_pose
from lidar_perception.sensor_setup.doubts import doubts, looks_elsewhere
from lidar_perception.sensor_setup.files import node_params, params_yaml
from lidar_perception.sensor_setup.findings import findings
from lidar_perception.sensor_setup.measure import measured
from lidar_perception.sensor_setup.motion import ahead_of, driven
from lidar_perception.sensor_setup.report import report_html
from lidar_perception.sensor_setup.scans import scan_of
from lidar_perception.sensor_setup.told import Told, told_by
from lidar_perception.simulation.scene import Scenes
from lidar_perception.simulation.sensor import sensor_named
from lidar_perception.simulation.to_bag import simulated_scans
from lidar_perception.wire.topics import ODOMETRY, TF_STATIC
from lidar_perception.wire.transforms import TF_MESSAGE

COUNT, HEIGHT = 8, 1.7


@cache
def drive():
    """Scans and poses of a sensor that drives ahead at a car's speed."""
    frames = list(simulated_scans(502, COUNT, sensor_named("vlp-16"), 40, Scenes(scene="street")))
    return [scan_of(_to_message(frame)) for frame in frames], [frame.pose() for frame in frames]


def on_robot(yaw, roll=0.0, pitch=0.0):
    """(4, 4): the sensor in the base."""
    a = np.radians(yaw)
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
    pose = turn @ make_tilted_pose(np.radians(roll), np.radians(pitch))
    pose[:3, 3] = 0.3, -0.1, 1.2
    return pose


def found(told, backwards=False):
    scans, _ = drive()
    return measured(scans[::-1] if backwards else scans, range(COUNT), "drive", COUNT, None, told)


def told(poses, actual, said=None, height=None):
    """As from a robot whose base is where the sensor's pose says, if its mount is actual."""
    return Told("base_link", said, None if height is None else make_tilted_pose(0, 0, height),
                {i: pose @ invert_pose(actual) for i, pose in enumerate(poses)})


@pytest.mark.parametrize("yaw", [0, pytest.param(-150, marks=pytest.mark.no_cover)])
def test_with_odometry_ahead_is_where_the_base_looks_whichever_way_it_drove(yaw):
    """The sensor's x is at yaw in the base, so the base's x is at -yaw in the sensor."""
    _, poses = drive()
    mount = on_robot(yaw)
    for backwards in (False, True):
        m = found(told(poses[::-1] if backwards else poses, mount, mount), backwards)
        assert m.heading.base and abs((m.heading.degrees + yaw + 180) % 360 - 180) < 3
        assert not any("by TF, x of" in line for line in doubts(m))
        looks = node_params(m).get("input.ahead", (0.0,))[0]
        assert abs((looks + yaw + 180) % 360 - 180) < 3
    if not yaw:
        without = found(Told(), backwards=True)
        assert abs(abs(without.heading.degrees) - 180) < 3  # it cannot know
        report_html(m, {"robot.param.yaml": params_yaml(m)})
    written = yaml.safe_load(params_yaml(m))["/**"]["ros__parameters"]["input"]
    assert written.pop("ahead", 0.0) == looks
    assert ReceptionParams(ahead=looks) and not written.keys() - {"intensity_max"}


def test_to_and_fro_is_told_with_odometry_only():
    shifts = {(i, i + 1): (-1) ** i * np.array([2.0, 0.5]) for i in range(8)}
    went = {pair: (-1) ** pair[0] * np.array([0.5, -2.0]) for pair in shifts}
    assert "to and fro" in ahead_of(shifts, {}).unknown
    assert ahead_of(shifts, went).degrees == pytest.approx(90)
    off = {pair: (np.cos(i), np.sin(i)) for i, pair in enumerate(shifts)}
    assert "does not agree" in ahead_of(shifts, off).unknown


def test_odometry_of_the_sensor_itself_says_where_it_drives_whatever_the_clouds_look_like():
    _, poses = drive()
    m = found(Told(poses={i: pose @ on_robot(30) for i, pose in enumerate(poses)}))
    assert m.heading.degrees == pytest.approx(-30, abs=1) and not m.heading.base


def test_odometry_of_a_part_of_the_clouds_does_not_make_the_robot_stand():
    _, poses = drive()
    m = found(Told("base_link", poses={COUNT - 1: poses[-1]}))
    assert m.coverage.still is False and not any("stands still" in line for line in doubts(m))


def test_many_pairs_of_one_place_are_led_alike_and_no_surer_than_one():
    alike = ahead_of({(i, i + 1): np.array([1.0, 0.25]) for i in range(40)}, {})
    assert alike.error >= 7 and not looks_elsewhere(alike)


def test_pairs_in_which_the_base_turned_or_is_not_known_say_nothing():
    turned = on_robot(10) @ invert_pose(on_robot(0))
    poses = {0: np.eye(4), 1: np.eye(4), 2: turned}
    steps = driven(poses, dict.fromkeys([(0, 1), (0, 2), (0, 7)]))
    assert steps == {(0, 1): (0, 0), (0, 2): None}


def test_what_tf_says_and_the_clouds_do_not_is_said_with_the_remedy():
    _, poses = drive()
    m = found(Told())
    roll, pitch = np.degrees([m.mount.roll, m.mount.pitch])
    true = on_robot(0, roll, pitch)
    right = found(told(poses, true, true, m.mount.height + 0.05))
    row = next(each for each in findings(right) if each.what == "mount by TF")
    assert row.sure == "sure" and "above 'base_footprint'" in row.how
    assert not any("URDF" in line for line in doubts(right))
    unposed = replace(right, told=right.told._replace(unposed="3 of 4 clouds have no pose"))
    assert any("by the clouds alone: 3 of 4 clouds" in line for line in doubts(unposed))
    for said, height, words in ((on_robot(0, roll + 3, pitch), None, "with roll"),
                                (on_robot(0, roll, pitch - 3), None, "and pitch"),
                                (on_robot(45, roll, pitch), None, "correct the yaw"),
                                (true, m.mount.height + 0.4, "above the ground")):
        wrong = found(told(poses, true, said, height))
        assert sum("URDF" in line and words in line for line in doubts(wrong)) == 1
        row = next(each for each in findings(wrong) if each.what == "mount by TF")
        assert row.sure == "doubtful"


def test_a_bag_tells_where_its_base_went_and_how_the_sensor_is_on_it(tmp_path):
    recorded(tmp_path / "bag", moving(ODOMETRY), mount("base_footprint", np.eye(4)), mount())
    clouds = open_clouds(tmp_path / "bag")
    said = told_by(clouds.poses, range(3), clouds.stamps_ns)
    assert said.base == "base_link" and said.ahead == pytest.approx(-90, abs=0.2)
    np.testing.assert_allclose(said.mount, ON_BASE, atol=1e-6)
    for i, pose in said.poses.items():
        np.testing.assert_allclose(pose, base_at(int(clouds.stamps_ns[i])), atol=1e-4)
    assert len(said.poses) == 3 and np.isnan(said.height)
    # A map that is fixed in the world is above what moves, and not the robot.
    world = TF_STATIC, TF_MESSAGE, START, tf(transform("world", "map", 0, np.eye(4)))
    recorded(tmp_path / "tf", moving_tf(), mount(), [world])
    clouds = open_clouds(tmp_path / "tf")
    assert told_by(clouds.poses, range(3), clouds.stamps_ns).base == "base_link"
    # Odometry that does not say what it is of is not taken for the base's.
    recorded(tmp_path / "of", moving(ODOMETRY, ""), mount())
    clouds = open_clouds(tmp_path / "of")
    nameless = told_by(clouds.poses, range(3), clouds.stamps_ns)
    assert nameless.base == "base_link" and nameless.poses == {}
    assert "child_frame_id" in nameless.unposed
    recorded(tmp_path / "bare", moving(ODOMETRY, ""))
    clouds = open_clouds(tmp_path / "bare")
    assert told_by(clouds.poses, range(3), clouds.stamps_ns) == Told(unposed=nameless.unposed)
    # A clock of its own: nothing is known at the times of the clouds.
    recorded(tmp_path / "clock", moving(ODOMETRY), mount())
    clouds = open_clouds(tmp_path / "clock")
    assert told_by(clouds.poses, range(3), clouds.stamps_ns).unposed == ""
    apart = told_by(clouds.poses, range(3), clouds.stamps_ns - 10**12)
    assert apart.poses == {} and apart.unposed.startswith("3 of 3 clouds have no pose")
    recorded(tmp_path / "stands", mount())
    clouds = open_clouds(tmp_path / "stands")
    fixed = told_by(clouds.poses, range(3), clouds.stamps_ns)
    assert fixed.base == "base_link" and fixed.unposed == ""
    recorded(tmp_path / "none")
    clouds = open_clouds(tmp_path / "none")
    assert told_by(clouds.poses, range(3), clouds.stamps_ns) == Told()
