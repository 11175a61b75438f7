"""Sensor poses from the odometry and TF that various robots record."""

import numpy as np
import pytest
from robot_bags import CLOUDS, ON_BASE, START, base_at, check, mount, moving, moving_tf, recorded, stamps, tf, transform
from scipy.spatial.transform import Rotation

from lidar_perception.data.bag_poses import FILTERED_ODOMETRY, choose_odometry_topic
from lidar_perception.data.frame import POSES
from lidar_perception.data.open import open_recording
from lidar_perception.data.to_bag import write_bag
from lidar_perception.robot.placement import make_tilted_pose
from lidar_perception.robot.poses import invert_pose
from lidar_perception.testing.clouds import make_cloud_message
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.messages import make_odometry
from lidar_perception.wire.topics import ODOMETRY, TF, TF_STATIC
from lidar_perception.wire.transforms import ODOMETRY_MESSAGE, TF_MESSAGE
from msg_utils.stamps import SECOND_NS, make_header


def wheel_transforms():
    """Yield transforms of wheels, which rotate for a while before the robot is localised."""
    for i in range(600):
        stamp = START - SECOND_NS + i * SECOND_NS // 1000
        yield TF, TF_MESSAGE, stamp, tf(transform("base_link", "wheel", stamp, np.eye(4)))


@pytest.mark.parametrize(
    "parts",
    [
        (moving(ODOMETRY), mount()),
        (moving(FILTERED_ODOMETRY), mount()),
        (moving("/kiss/odometry"), mount()),
        (moving_tf(), mount()),
        (moving(ODOMETRY), moving("/wheels", "wheels"), moving_tf(), mount()),
        (wheel_transforms(), moving_tf(), mount()),
    ],
    ids=["odom", "filtered", "the only one", "TF", "all of them", "late TF"],
)
def test_poses_come_from_odometry_and_tf_at_cloud_times(tmp_path, parts):
    check(recorded(tmp_path / "bag", *map(list, parts)))


def test_odometry_without_tf_is_the_pose_of_the_sensor(tmp_path):
    own = recorded(tmp_path / "own", moving(ODOMETRY, "lidar"), mount())
    unknown = recorded(tmp_path / "unknown", moving(ODOMETRY, "chassis"), mount())
    check(own, np.eye(4))
    check(unknown, np.eye(4))
    assert own.frames.poses.needs_no_tf and not unknown.frames.poses.needs_no_tf


def test_odometry_of_another_frame_is_transformed_to_the_sensor(tmp_path):
    """The other frame is an IMU, or a base_footprint below the base."""
    imu = make_tilted_pose(0.1, 0.2, 0.3)
    mounting = [(TF_STATIC, TF_MESSAGE, START, tf(transform("base_link", "imu", 0, imu)))]
    check(recorded(tmp_path / "bag", moving(ODOMETRY, "imu"), mount(), mounting), invert_pose(imu) @ ON_BASE)


def test_poses_of_clouds_in_the_odometry_frame_are_identity(tmp_path):
    still = recorded(
        tmp_path / "bag", moving(ODOMETRY), cloud=lambda stamp: make_cloud_message(np.ones((3, 4)), stamp, "odom")
    )
    assert all(np.array_equal(frame.pose(), np.eye(4)) for frame in still)


def test_converted_bag_has_sensor_odometry(tmp_path):
    robot = recorded(tmp_path / "robot", moving(FILTERED_ODOMETRY), mount())
    write_bag(tmp_path / "ours", robot)
    ours = open_recording(tmp_path / "ours")
    check(ours)
    assert ours.frames.poses.needs_no_tf and ours.frames.poses.odometry_topic == ODOMETRY


def test_sensor_that_rotates_on_the_robot_has_correct_poses(tmp_path):
    def turning():
        for i in range(-5, 60):
            stamp = START + i * SECOND_NS // 100
            yield TF, TF_MESSAGE, stamp, tf(transform("base_link", "lidar", stamp, on_base(stamp)))

    def on_base(stamp):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("z", 2 * (stamp - START) / SECOND_NS).as_matrix()
        return pose

    for frame, stamp in zip(recorded(tmp_path / "bag", moving(ODOMETRY), turning()), stamps()):
        np.testing.assert_allclose(frame.pose(), base_at(stamp) @ on_base(stamp), atol=1e-4)


def test_missing_or_ambiguous_poses_are_none(tmp_path):
    fixed = recorded(tmp_path / "fixed", mount())  # static transforms only
    assert POSES not in fixed.contents and [frame.pose() for frame in fixed] == [None] * CLOUDS
    two = recorded(tmp_path / "two", moving("/left"), moving("/right"))
    assert POSES not in two.contents
    short = recorded(
        tmp_path / "short",
        moving(ODOMETRY, "lidar", seconds=-1),
        [
            (
                ODOMETRY,
                ODOMETRY_MESSAGE,
                START - SECOND_NS,
                make_odometry(
                    base_at(START), make_header(START - SECOND_NS, "odom", make_bag_message), "lidar", make_bag_message
                ),
            )
        ],
    )
    assert [frame.pose() for frame in short] == [None] * CLOUDS  # the odometry ends a second earlier
    circle = recorded(
        tmp_path / "circle",
        [
            (
                TF_STATIC,
                TF_MESSAGE,
                START,
                tf(transform("a", "lidar", 0, np.eye(4)), transform("lidar", "a", 0, np.eye(4))),
            )
        ],
    )
    assert POSES not in circle.contents
    other = recorded(
        tmp_path / "other", [(TF, "std_msgs/msg/String", START, make_bag_message("std_msgs/msg/String", data="text"))]
    )
    assert POSES not in other.contents


def test_invalid_poses_are_skipped_and_counted(tmp_path):
    def broken():
        message = next(iter(moving(ODOMETRY)))[3]
        message.pose.pose.orientation.w = message.pose.pose.orientation.z = 0.0
        yield ODOMETRY, ODOMETRY_MESSAGE, START - SECOND_NS, message

    recording = recorded(tmp_path / "bag", broken(), moving(ODOMETRY), mount())
    check(recording)
    assert recording.frames.poses.invalid_count == 1


def test_odometry_topic_is_the_common_name_or_the_only_one():
    kind = ODOMETRY_MESSAGE
    assert choose_odometry_topic({"/b": kind, ODOMETRY: kind, FILTERED_ODOMETRY: kind}) == ODOMETRY
    assert choose_odometry_topic({"/b": kind, FILTERED_ODOMETRY: kind}) == FILTERED_ODOMETRY
    assert choose_odometry_topic({"/b": kind, ODOMETRY: "std_msgs/msg/String"}) == "/b"
    assert choose_odometry_topic({"/b": kind, "/c": kind}) == choose_odometry_topic({}) == ""
