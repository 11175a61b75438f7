"""launch/two_lidars.launch.py: each sensor's clouds give its own results, all end with 0.

Runs where launch_testing is installed (a full ROS 2); test_reception.py tests the same with plain
processes everywhere.
"""

from __future__ import annotations

import unittest
from pathlib import Path
from time import monotonic

import numpy as np
import pytest

pytest.importorskip("launch_testing", reason="needs launch_testing, which comes with ROS 2")
pytest.importorskip("launch_ros", reason="needs launch_ros, which comes with ROS 2")

import launch_testing
import launch_testing.actions
import launch_testing.asserts
import rclpy
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from launch import LaunchDescription
from lidar_perception.nodes.graph import STAGES
from msg_utils.messages import ros_message
from msg_utils.point_cloud2 import from_array
from msg_utils.stamps import header_message

LAUNCH = Path(__file__).resolve().parents[2] / "launch" / "two_lidars.launch.py"
SIDES = {"left": "/lidar_left", "right": "/right/points"}  # where their clouds come from
TIMEOUT = 120.0  # seconds; the first start compiles


@pytest.mark.launch_test
def generate_test_description():
    graph = IncludeLaunchDescription(PythonLaunchDescriptionSource(str(LAUNCH)),
                                     launch_arguments={"left": SIDES["left"]}.items())
    return LaunchDescription([graph, launch_testing.actions.ReadyToTest()])


class TestTwoLidars(unittest.TestCase):
    def test_each_has_its_own_results(self):
        rclpy.init()
        node = rclpy.create_node("peer")
        heard = {side: [] for side in SIDES}
        points = np.random.default_rng(0).uniform(-20, 20, (5000, 3)).astype(np.float32)
        points[:, 2] = -1.73
        street = points.view([(n, "<f4") for n in "xyz"]).reshape(-1)
        talkers = {side: node.create_publisher(PointCloud2, SIDES[side], 5) for side in SIDES}
        for side, messages in heard.items():
            node.create_subscription(
                MarkerArray, f"/{side}/candidate_refinement/output/detections",
                messages.append, 10)
        end = monotonic() + TIMEOUT
        while not all(heard.values()) and monotonic() < end:
            for side, talker in talkers.items():
                talker.publish(from_array(street, header_message(10**9, side, ros_message),
                                          ros_message))
            rclpy.spin_once(node, timeout_sec=0.2)
        node.destroy_node()
        rclpy.try_shutdown()
        for side, messages in heard.items():
            assert {m.header.frame_id for a in messages for m in a.markers} == {side}


@launch_testing.post_shutdown_test()
class TestAfterwards(unittest.TestCase):
    def test_all_nodes_ended_with_code_0(self, proc_info):
        launch_testing.asserts.assertExitCodes(proc_info)
        assert sorted(name.split("-")[0] for name in proc_info.process_names()) == sorted(
            2 * list(STAGES))
