"""launch/perception.launch.py behind a driver of another package, a process without our Fast DDS
profile: every cloud is accounted for, candidates come, all end with 0.

Runs where launch_testing is installed (a full ROS 2); test_reception.py tests the same with plain
processes everywhere.
"""

from __future__ import annotations

import os
import subprocess
import sys
import unittest
from pathlib import Path
from time import monotonic

import pytest

pytest.importorskip("launch_testing", reason="needs launch_testing, which comes with ROS 2")
pytest.importorskip("launch_ros", reason="needs launch_ros, which comes with ROS 2")

import launch_testing
import launch_testing.actions
import launch_testing.asserts
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from visualization_msgs.msg import MarkerArray

from launch import LaunchDescription
from lidar_perception.nodes.main import PROFILE_VARIABLES

ROOT = Path(__file__).resolve().parents[2]
LAUNCH, DRIVER = ROOT / "launch" / "perception.launch.py", ROOT / "test" / "ros" / "driver.py"
COUNT, POINTS = 20, 130_000  # clouds of 2 MB
TIMEOUT = 120.0  # seconds; the first start compiles


@pytest.mark.launch_test
def generate_test_description():
    graph = IncludeLaunchDescription(PythonLaunchDescriptionSource(str(LAUNCH)), launch_arguments={
        "points": "/driver_points", "single": "true"}.items())
    return LaunchDescription([graph, launch_testing.actions.ReadyToTest()])


class TestDriver(unittest.TestCase):
    def test_every_cloud_is_accounted_for(self):
        environment = {k: v for k, v in os.environ.items() if k not in PROFILE_VARIABLES}
        driver = subprocess.Popen(
            [sys.executable, DRIVER, "/driver_points", "reliable",
             *map(str, (COUNT, 10, POINTS, 1))], env=environment,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        rclpy.init()
        node = rclpy.create_node("listener")
        found, values = [], {}

        def heard(message):
            for status in message.status:
                if status.name == "perception":
                    values.update((v.key, v.value) for v in status.values)

        node.create_subscription(MarkerArray, "/perception/output/detections", found.append, 10)
        node.create_subscription(DiagnosticArray, "/diagnostics", heard, 10)

        def done():
            return sum(int(values.get(key, 0)) for key in ("frames", "dropped")) == COUNT

        end = monotonic() + TIMEOUT
        while not (done() and found) and monotonic() < end:
            rclpy.spin_once(node, timeout_sec=0.1)
        driver.communicate("\n", timeout=20)
        node.destroy_node()
        rclpy.try_shutdown()
        assert done() and found, values
        assert (values["lost"], values["reliability"]) == ("0", "reliable")


@launch_testing.post_shutdown_test()
class TestAfterwards(unittest.TestCase):
    def test_all_nodes_ended_with_code_0(self, proc_info):
        launch_testing.asserts.assertExitCodes(proc_info)
        assert [name.split("-")[0] for name in proc_info.process_names()] == ["perception"]
