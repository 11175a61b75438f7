"""Sensor poses from the odometry and TF that various robots record."""

import numpy as np
import pytest
from robot_bags import (
    CLOUDS,
    ON_BASE,
    START,
    check_poses,
    compute_base_pose,
    list_stamps,
    make_mount_rows,
    make_odometry_rows,
    make_tf_message,
    make_tf_rows,
    make_transform,
    write_robot_bag,
)
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


def make_wheel_transforms():
    """Yield transforms of wheels, which rotate for a while before the robot is localised."""
    for i in range(600):
        stamp = START - SECOND_NS + i * SECOND_NS // 1000
        yield TF, TF_MESSAGE, stamp, make_tf_message(make_transform("base_link", "wheel", stamp, np.eye(4)))


@pytest.mark.parametrize(
    "parts",
    [
        (make_odometry_rows(ODOMETRY), make_mount_rows()),
        (make_odometry_rows(FILTERED_ODOMETRY), make_mount_rows()),
        (make_odometry_rows("/kiss/odometry"), make_mount_rows()),
        (make_tf_rows(), make_mount_rows()),
        (make_odometry_rows(ODOMETRY), make_odometry_rows("/wheels", "wheels"), make_tf_rows(), make_mount_rows()),
        (make_wheel_transforms(), make_tf_rows(), make_mount_rows()),
    ],
    ids=["odom", "filtered", "the only one", "TF", "all of them", "late TF"],
)
def test_poses_come_from_odometry_and_tf_at_cloud_times(tmp_path, parts):
    check_poses(write_robot_bag(tmp_path / "bag", *map(list, parts)))


def test_odometry_without_tf_is_the_pose_of_the_sensor(tmp_path):
    own = write_robot_bag(tmp_path / "own", make_odometry_rows(ODOMETRY, "lidar"), make_mount_rows())
    unknown = write_robot_bag(tmp_path / "unknown", make_odometry_rows(ODOMETRY, "chassis"), make_mount_rows())
    check_poses(own, np.eye(4))
    check_poses(unknown, np.eye(4))
    assert own.frames.poses.needs_no_tf and not unknown.frames.poses.needs_no_tf


def test_odometry_of_another_frame_is_transformed_to_the_sensor(tmp_path):
    """The other frame is an IMU, or a base_footprint below the base."""
    imu = make_tilted_pose(0.1, 0.2, 0.3)
    mounting = [(TF_STATIC, TF_MESSAGE, START, make_tf_message(make_transform("base_link", "imu", 0, imu)))]
    check_poses(
        write_robot_bag(tmp_path / "bag", make_odometry_rows(ODOMETRY, "imu"), make_mount_rows(), mounting),
        invert_pose(imu) @ ON_BASE,
    )


def test_poses_of_clouds_in_the_odometry_frame_are_identity(tmp_path):
    recording = write_robot_bag(
        tmp_path / "bag",
        make_odometry_rows(ODOMETRY),
        cloud=lambda stamp: make_cloud_message(np.ones((3, 4)), stamp, "odom"),
    )
    assert all(np.array_equal(frame.pose(), np.eye(4)) for frame in recording)


def test_converted_bag_has_sensor_odometry(tmp_path):
    robot = write_robot_bag(tmp_path / "robot", make_odometry_rows(FILTERED_ODOMETRY), make_mount_rows())
    write_bag(tmp_path / "ours", robot)
    ours = open_recording(tmp_path / "ours")
    check_poses(ours)
    assert ours.frames.poses.needs_no_tf and ours.frames.poses.odometry_topic == ODOMETRY


def test_sensor_that_rotates_on_the_robot_has_correct_poses(tmp_path):
    def make_rotating_transforms():
        for i in range(-5, 60):
            stamp = START + i * SECOND_NS // 100
            yield (
                TF,
                TF_MESSAGE,
                stamp,
                make_tf_message(make_transform("base_link", "lidar", stamp, compute_pose_on_base(stamp))),
            )

    def compute_pose_on_base(stamp):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("z", 2 * (stamp - START) / SECOND_NS).as_matrix()
        return pose

    for frame, stamp in zip(
        write_robot_bag(tmp_path / "bag", make_odometry_rows(ODOMETRY), make_rotating_transforms()), list_stamps()
    ):
        np.testing.assert_allclose(frame.pose(), compute_base_pose(stamp) @ compute_pose_on_base(stamp), atol=1e-4)


def test_missing_or_ambiguous_poses_are_none(tmp_path):
    fixed = write_robot_bag(tmp_path / "fixed", make_mount_rows())  # static transforms only
    assert POSES not in fixed.contents and [frame.pose() for frame in fixed] == [None] * CLOUDS
    two = write_robot_bag(tmp_path / "two", make_odometry_rows("/left"), make_odometry_rows("/right"))
    assert POSES not in two.contents
    short = write_robot_bag(
        tmp_path / "short",
        make_odometry_rows(ODOMETRY, "lidar", seconds=-1),
        [
            (
                ODOMETRY,
                ODOMETRY_MESSAGE,
                START - SECOND_NS,
                make_odometry(
                    compute_base_pose(START),
                    make_header(START - SECOND_NS, "odom", make_bag_message),
                    "lidar",
                    make_bag_message,
                ),
            )
        ],
    )
    assert [frame.pose() for frame in short] == [None] * CLOUDS  # the odometry ends a second earlier
    circle = write_robot_bag(
        tmp_path / "circle",
        [
            (
                TF_STATIC,
                TF_MESSAGE,
                START,
                make_tf_message(make_transform("a", "lidar", 0, np.eye(4)), make_transform("lidar", "a", 0, np.eye(4))),
            )
        ],
    )
    assert POSES not in circle.contents
    other = write_robot_bag(
        tmp_path / "other", [(TF, "std_msgs/msg/String", START, make_bag_message("std_msgs/msg/String", data="text"))]
    )
    assert POSES not in other.contents


def test_invalid_poses_are_skipped_and_counted(tmp_path):
    def make_invalid_odometry():
        message = next(iter(make_odometry_rows(ODOMETRY)))[3]
        message.pose.pose.orientation.w = message.pose.pose.orientation.z = 0.0
        yield ODOMETRY, ODOMETRY_MESSAGE, START - SECOND_NS, message

    recording = write_robot_bag(
        tmp_path / "bag", make_invalid_odometry(), make_odometry_rows(ODOMETRY), make_mount_rows()
    )
    check_poses(recording)
    assert recording.frames.poses.invalid_count == 1


def test_odometry_topic_is_the_common_name_or_the_only_one():
    kind = ODOMETRY_MESSAGE
    assert choose_odometry_topic({"/b": kind, ODOMETRY: kind, FILTERED_ODOMETRY: kind}) == ODOMETRY
    assert choose_odometry_topic({"/b": kind, FILTERED_ODOMETRY: kind}) == FILTERED_ODOMETRY
    assert choose_odometry_topic({"/b": kind, ODOMETRY: "std_msgs/msg/String"}) == "/b"
    assert choose_odometry_topic({"/b": kind, "/c": kind}) == choose_odometry_topic({}) == ""
