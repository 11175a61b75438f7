"""Where the sensor of a bag was, by what other robots record."""

import numpy as np
import pytest
from robot_bags import (
    CLOUDS,
    ON_BASE,
    START,
    base_at,
    check,
    mount,
    moving,
    moving_tf,
    recorded,
    stamps,
    tf,
    transform,
)
from scipy.spatial.transform import Rotation

from lidar_perception.data.bag_poses import FILTERED, odometry_topic
from lidar_perception.data.frame import POSES
from lidar_perception.data.open import open_recording
from lidar_perception.data.to_bag import write_bag
from lidar_perception.robot.placement import make_tilted_pose
from lidar_perception.robot.poses import invert_pose
from lidar_perception.testing.clouds import cloud_message
from lidar_perception.wire.codec import bag_message
from lidar_perception.wire.messages import make_odometry
from lidar_perception.wire.topics import ODOMETRY, TF, TF_STATIC
from lidar_perception.wire.transforms import ODOMETRY_MESSAGE, TF_MESSAGE
from msg_utils.stamps import SECOND, header_message


def wheels():
    """They turn for a while before the robot is localised."""
    for i in range(600):
        stamp = START - SECOND + i * SECOND // 1000
        yield TF, TF_MESSAGE, stamp, tf(transform("base_link", "wheel", stamp, np.eye(4)))


@pytest.mark.parametrize("parts", [
    (moving(ODOMETRY), mount()), (moving(FILTERED), mount()), (moving("/kiss/odometry"), mount()),
    (moving_tf(), mount()), (moving(ODOMETRY), moving("/wheels", "wheels"), moving_tf(), mount()),
    (wheels(), moving_tf(), mount()),
], ids=["odom", "filtered", "the only one", "TF", "all of them", "late TF"])
def test_the_sensor_is_where_odometry_and_tf_say_at_the_time_of_its_cloud(tmp_path, parts):
    check(recorded(tmp_path / "bag", *map(list, parts)))


def test_odometry_of_the_sensor_itself_or_of_what_tf_does_not_know_is_the_sensors(tmp_path):
    own = recorded(tmp_path / "own", moving(ODOMETRY, "lidar"), mount())
    unknown = recorded(tmp_path / "unknown", moving(ODOMETRY, "chassis"), mount())
    check(own, np.eye(4))
    check(unknown, np.eye(4))
    assert own.frames.poses.plain and not unknown.frames.poses.plain


def test_odometry_of_another_part_of_the_robot_is_carried_to_the_sensor(tmp_path):
    """As of an inertial sensor beside it, or of a base_footprint below the base."""
    imu = make_tilted_pose(0.1, 0.2, 0.3)
    beside = [(TF_STATIC, TF_MESSAGE, START, tf(transform("base_link", "imu", 0, imu)))]
    check(recorded(tmp_path / "bag", moving(ODOMETRY, "imu"), mount(), beside),
          invert_pose(imu) @ ON_BASE)


def test_clouds_in_the_frame_of_the_odometry_do_not_move(tmp_path):
    still = recorded(tmp_path / "bag", moving(ODOMETRY), cloud=lambda stamp: cloud_message(
        np.ones((3, 4)), stamp, "odom"))
    assert all(np.array_equal(frame.pose(), np.eye(4)) for frame in still)


def test_as_a_bag_of_ours_the_sensors_poses_are_the_odometry(tmp_path):
    robot = recorded(tmp_path / "robot", moving(FILTERED), mount())
    write_bag(tmp_path / "ours", robot)
    ours = open_recording(tmp_path / "ours")
    check(ours)
    assert ours.frames.poses.plain and ours.frames.poses.odometry == ODOMETRY


def test_a_sensor_that_turns_on_the_robot_is_where_it_was(tmp_path):
    def turning():
        for i in range(-5, 60):
            stamp = START + i * SECOND // 100
            yield TF, TF_MESSAGE, stamp, tf(transform("base_link", "lidar", stamp, on_base(stamp)))

    def on_base(stamp):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("z", 2 * (stamp - START) / SECOND).as_matrix()
        return pose

    for frame, stamp in zip(recorded(tmp_path / "bag", moving(ODOMETRY), turning()), stamps()):
        np.testing.assert_allclose(frame.pose(), base_at(stamp) @ on_base(stamp), atol=1e-4)


def test_what_says_nothing_gives_no_pose_and_nothing_is_guessed(tmp_path):
    fixed = recorded(tmp_path / "fixed", mount())  # nothing moves
    assert POSES not in fixed.has and [frame.pose() for frame in fixed] == [None] * CLOUDS
    two = recorded(tmp_path / "two", moving("/left"), moving("/right"))
    assert POSES not in two.has
    short = recorded(tmp_path / "short", moving(ODOMETRY, "lidar", seconds=-1),
                     [(ODOMETRY, ODOMETRY_MESSAGE, START - SECOND, make_odometry(
                         base_at(START), header_message(START - SECOND, "odom", bag_message),
                         "lidar", bag_message))])
    assert [frame.pose() for frame in short] == [None] * CLOUDS  # it ended a second before
    circle = recorded(tmp_path / "circle", [(TF_STATIC, TF_MESSAGE, START, tf(
        transform("a", "lidar", 0, np.eye(4)), transform("lidar", "a", 0, np.eye(4))))])
    assert POSES not in circle.has
    other = recorded(tmp_path / "other", [(TF, "std_msgs/msg/String", START, bag_message(
        "std_msgs/msg/String", data="of something else"))])
    assert POSES not in other.has


def test_what_is_no_pose_is_left_out_and_counted(tmp_path):
    def broken():
        message = next(iter(moving(ODOMETRY)))[3]
        message.pose.pose.orientation.w = message.pose.pose.orientation.z = 0.0
        yield ODOMETRY, ODOMETRY_MESSAGE, START - SECOND, message

    recording = recorded(tmp_path / "bag", broken(), moving(ODOMETRY), mount())
    check(recording)
    assert recording.frames.poses.left_out == 1


def test_the_topic_is_the_known_one_or_the_only_one():
    kind = ODOMETRY_MESSAGE
    assert odometry_topic({"/b": kind, ODOMETRY: kind, FILTERED: kind}) == ODOMETRY
    assert odometry_topic({"/b": kind, FILTERED: kind}) == FILTERED
    assert odometry_topic({"/b": kind, ODOMETRY: "std_msgs/msg/String"}) == "/b"
    assert odometry_topic({"/b": kind, "/c": kind}) == odometry_topic({}) == ""
