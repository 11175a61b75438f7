"""Reading of ROS 1 bags."""

import shutil

import numpy as np
import pytest
from bag_samples import as_ros1
from robot_bags import (
    check_poses,
    make_mount_rows,
    make_odometry_rows,
    make_tf_message,
    make_transform,
    write_robot_bag,
)
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from lidar_perception.data.bag import Bag
from lidar_perception.data.open import open_recording
from lidar_perception.data.raw_clouds import open_clouds
from lidar_perception.types import InputError
from lidar_perception.wire.topics import ODOMETRY

pytestmark = pytest.mark.no_cover  # covered by other tests


@pytest.mark.parametrize("compress", [None, "lz4"])
def test_ros1_bag_equals_the_ros2_bag(drive_bag, tmp_path, compress):
    ours = open_recording(drive_bag)
    theirs = open_recording(as_ros1(drive_bag, tmp_path / "drive.bag", compress))
    assert theirs.contents == ours.contents and len(theirs) == len(ours)
    assert "ROS 1 bag, clouds on /points" in str(theirs)
    for a, b in zip(theirs, ours):
        assert (a.name, a.stamp_ns) == (b.name, b.stamp_ns)
        np.testing.assert_array_equal(a.load().xyz, b.load().xyz)
        np.testing.assert_array_equal(a.load().intensity, b.load().intensity)
        np.testing.assert_array_equal(a.truth().boxes, b.truth().boxes)
        assert a.truth().labels == b.truth().labels and (a.camera() is None) == (b.camera() is None)
    by_number = open_clouds(tmp_path / "drive.bag")
    np.testing.assert_array_equal(by_number.load(len(ours) - 1).data, open_clouds(drive_bag).load(len(ours) - 1).data)


def test_folder_with_bag_suffix_is_a_ros2_bag(drive_bag, tmp_path):
    shutil.copytree(drive_bag, tmp_path / "drive.bag")
    assert "rosbag2 bag" in str(open_recording(tmp_path / "drive.bag"))


def test_poses_come_from_odometry_and_tf(tmp_path):
    write_robot_bag(tmp_path / "robot", make_odometry_rows(ODOMETRY), make_mount_rows())
    check_poses(open_recording(as_ros1(tmp_path / "robot", tmp_path / "robot.bag", "bz2")))


def test_ros1_tf_latched_topics_and_unknown_types_are_read(tmp_path):
    store = get_typestore(Stores.ROS1_NOETIC)
    for kind in ("tf/msg/tfMessage", "tf2_msgs/msg/TFMessage", "driver_msgs/msg/Packet"):
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
    stamped = make_tf_message(make_transform("a", "b", 0, np.eye(4)))
    with Writer(tmp_path / "old.bag") as bag:
        for topic, kind, latched in (
            ("/tf", "tf/msg/tfMessage", 0),
            ("/tf_static", "tf2_msgs/msg/TFMessage", 1),
            ("/packets", "driver_msgs/msg/Packet", 0),
        ):
            connection = bag.add_connection(topic, kind, typestore=store, latching=latched)
            ros2 = stamped.transforms[0]
            header = store.types["std_msgs/msg/Header"](seq=7, stamp=ros2.header.stamp, frame_id=ros2.header.frame_id)
            ros1 = type(ros2)(header=header, child_frame_id="b", transform=ros2.transform)
            bag.write(connection, 5, store.serialize_ros1(store.types[kind](transforms=[ros1]), kind))
    with Bag(tmp_path / "old.bag") as bag:
        assert set(bag.topics.values()) == {"tf2_msgs/msg/TFMessage"}
        assert bag.counts == {"/tf": 1, "/tf_static": 1}
        assert [bool(bag.find_qos(topic)) for topic in ("/tf", "/tf_static")] == [False, True]
        for _, time, msg in bag.messages(bag.topics):
            assert time == 5 and msg.transforms[0].child_frame_id == "b"


def test_damaged_bag_is_reported_in_one_line(drive_bag, tmp_path):
    whole = as_ros1(drive_bag, tmp_path / "whole.bag").read_bytes()
    rng = np.random.default_rng(0)
    (tmp_path / "text.bag").write_bytes(b"text " * 100)
    for i, length in enumerate([*rng.integers(0, len(whole), 12).tolist(), len(whole) - 1]):
        (tmp_path / f"{i}.bag").write_bytes(whole[:length])
    for path in [tmp_path / "text.bag", *(tmp_path / f"{i}.bag" for i in range(13))]:
        with pytest.raises(InputError, match="truncated or damaged") as error:
            [frame.load() for frame in open_recording(path)]
        assert "\n" not in str(error.value) and path.name in str(error.value)


def test_sensor_packets_are_reported_with_their_driver(tmp_path):
    store = get_typestore(Stores.ROS1_NOETIC)
    kind = "velodyne_msgs/msg/VelodyneScan"
    store.register(get_types_from_msg("uint8[] packets", kind))
    with Writer(tmp_path / "packets.bag") as bag:
        connection = bag.add_connection("/velodyne_packets", kind, typestore=store)
        bag.write(connection, 5, bytes(4))
    with pytest.raises(InputError, match=r"VelodyneScan on /velodyne_packets .*velodyne_"):
        open_recording(tmp_path / "packets.bag")
