"""Motion compensation in the nodes, by odometry or TF."""

from __future__ import annotations

import numpy as np
import pytest
from motion_samples import skew

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from motion_samples import make_constant_motion
from robot_messages import (
    PERIOD,
    START,
    deliver_cloud,
    list_problems,
    make_base_odometry,
    make_robot_cloud,
    mount_pose,
    transforms,
)

from lidar_perception.nodes.ground_segmentation import GroundSegmentation
from lidar_perception.wire.codec import decode, encode, make_bag_message
from lidar_perception.wire.messages import read_column, to_point_cloud
from msg_utils.point_cloud2 import to_array
from msg_utils.stamps import make_time

pytestmark = pytest.mark.usefixtures("one_thread")


def compute_base_pose(at_ns):
    """Return the pose of the base in odom: 15 m/s on a left turn."""
    return make_constant_motion([15.0, 0.0, 0.0], [0.0, 0.0, 0.5])(np.array([(at_ns - START) * 1e-9]))[0]


@pytest.mark.parametrize("source", ["odometry", "tf"])
def test_cloud_of_moving_sensor_is_compensated(start_node, source):
    """Subsequent nodes get the compensated points. Points on the robot's body are not moved. Without odometry the cloud
    is used uncompensated, with a warning."""
    rng = np.random.default_rng(0)
    sensor = mount_pose(1.2, 0.1, 1.8, 0.5, 0.0, 0.0)
    static_xyz = np.vstack(
        [
            rng.uniform(-30, 30, (3000, 3)) * [1, 1, 0.001] - [0, 0, 1.8],
            rng.uniform(-0.5, 0.5, (50, 3)) + [-1.0, 0, -0.6],
        ]
    ).astype(np.float32)
    body = np.arange(3000, 3050)
    seconds = rng.uniform(0.0, 0.1, len(static_xyz))

    def poses(at):
        return np.array([compute_base_pose(START + round(s * 1e9)) @ sensor for s in at])

    raw = skew(static_xyz, seconds, poses)
    raw[body] = static_xyz[body]
    node = start_node(
        GroundSegmentation,
        **{"input.deskew": source, "base_frame": "base", "crop.body": [-1.5, -1.5, 0.2, 2.0, 1.5, 2.5]},
    )
    node.transforms.on_tf(transforms(("base", "lidar", sensor, 0)), static=True)
    msg = make_robot_cloud(raw, t=np.rint(seconds * 1e9).astype("<u4"))

    deliver_cloud(node, msg)
    as_it_is = decode(node.sent["points"][-1], "sensor_msgs/msg/PointCloud2")
    np.testing.assert_array_equal(to_array(as_it_is)["x"], raw[:, 0])
    assert node.diagnostics.counts["not_deskewed"] == 1
    assert "clouds are not deskewed" in list_problems(node)

    for i in range(-5, 16):
        stamp = START + i * PERIOD // 10
        if source == "tf":
            node.transforms.on_tf(transforms(("odom", "base", compute_base_pose(stamp), stamp)), static=False)
        else:
            node.transforms.on_odometry(make_base_odometry(compute_base_pose(stamp), stamp))
    deliver_cloud(node, msg)
    assert "deskew" not in list_problems(node) and node.diagnostics.counts["deskewed"] == 1
    after = decode(node.sent["points"][-1], "sensor_msgs/msg/PointCloud2")
    compensated_xyz = np.column_stack([to_array(after)[n] for n in "xyz"])
    others = np.setdiff1d(np.arange(len(static_xyz)), body)
    wrong = np.linalg.norm(raw - static_xyz, axis=1)[others]
    np.testing.assert_allclose(compensated_xyz[others], static_xyz[others], atol=5e-3)
    assert np.median(wrong) > 0.5
    np.testing.assert_array_equal(compensated_xyz[body], static_xyz[body])
    assert not read_column(after, "in_view", body).any() and not to_array(after)["t"].any()
    frame_, _ = to_point_cloud(after)
    second_node = start_node(GroundSegmentation, **{"input.deskew": source})
    second_node.transforms = node.transforms
    deliver_cloud(second_node, after)
    np.testing.assert_array_equal(  # compensated only once
        to_array(decode(second_node.sent["points"][-1], "sensor_msgs/msg/PointCloud2"))["x"], compensated_xyz[:, 0]
    )
    deliver_cloud(node, make_robot_cloud(raw, START + PERIOD))
    assert "no time column" in list_problems(node) and len(node.sent["points"]) == 3
    assert make_time(START, make_bag_message).sec == after.header.stamp.sec and len(frame_)


def test_first_cloud_waits_for_odometry_of_its_sweep(start_node):
    rng = np.random.default_rng(0)
    xyz = (rng.uniform(-30, 30, (2000, 3)) * [1, 1, 0.001] - [0, 0, 1.8]).astype(np.float32)
    msg = make_robot_cloud(xyz, t=np.linspace(0, 1e8, len(xyz)).astype("<u4"))
    node = start_node(GroundSegmentation, **{"input.deskew": "odometry"})
    deliver = node.inputs.receptions[0].deliver
    for i in range(-2, 9):
        node.transforms.on_odometry(make_base_odometry(np.eye(4), START + i * PERIOD // 10, "lidar"))
    needed = deliver(encode(msg), True)
    assert "/ground_segmentation/input/odometry" in needed and "0.020 s older" in needed
    assert "'lidar'" in needed and "child_frame_id" not in needed
    assert node.diagnostics.counts["frames"] == 0
    for i in (9, 10):
        node.transforms.on_odometry(make_base_odometry(np.eye(4), START + i * PERIOD // 10, "lidar"))
    assert deliver(encode(msg), True) is None
    assert node.diagnostics.counts["deskewed"] == 1 and "not_deskewed" not in node.diagnostics.counts


@pytest.mark.parametrize("first, begin, sectors", [(0.3, 0.0, ()), (1.0, -1.0, (120.0, 240.0))])
def test_later_clouds_wait_for_the_end_of_their_sweep(start_node, first, begin, sectors):
    """The first sweep is partial, or the stamp is at the end of a sweep whose last points are cropped. Odometry
    arrives every 0.02 s."""
    node = start_node(GroundSegmentation, **{"input.deskew": "odometry", "crop.sectors": sectors})
    deliver = node.inputs.receptions[0].deliver
    odometry_stamps = iter(range(START, START + 20 * PERIOD, PERIOD // 5))

    def hear():
        stamp = next(odometry_stamps)
        node.transforms.on_odometry(make_base_odometry(np.eye(4), stamp, "lidar"))
        return stamp

    known = hear()
    for i in range(1, 8):
        share = np.linspace(0, 1, 400)[: round(400 * (first if i == 1 else 1.0))]
        angle, seconds = np.pi - 2 * np.pi * share, 0.0999 * (begin + share)
        xyz = np.column_stack([20 * np.cos(angle), 20 * np.sin(angle), np.full(len(angle), -1.7)])
        stamp = START + i * PERIOD + PERIOD // 10
        while known < stamp + 1e9 * seconds[-1] - PERIOD // 5:
            known = hear()
        while deliver(encode(make_robot_cloud(xyz, stamp, time=seconds.astype("<f4"))), True):
            known = hear()
    assert node.diagnostics.counts["deskewed"] == 7 - (
        first < 1.0
    )  # after a partial first sweep the second cloud is not deskewed, because the duration is unknown
