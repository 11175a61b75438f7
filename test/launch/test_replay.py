"""launch/replay.launch.py with a bag made here: candidates come, the bag is scored, all end with 0.

Runs where launch_testing is installed (a full ROS 2); test_graph.py tests the same scenario
with plain processes everywhere.
"""

from __future__ import annotations

import json
import tempfile
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
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from visualization_msgs.msg import MarkerArray

from launch import LaunchDescription
from lidar_perception.data.to_bag import write_bag
from lidar_perception.nodes.graph import STAGES, result_topics
from lidar_perception.simulation.scene import CROWDED
from lidar_perception.simulation.to_bag import simulated_scans

LAUNCH = Path(__file__).resolve().parents[2] / "launch" / "replay.launch.py"
FOLDER = Path(tempfile.mkdtemp())
FRAMES = 6
TIMEOUT = 120.0  # seconds; the first start compiles


@pytest.mark.launch_test
def generate_test_description():
    write_bag(FOLDER / "drive", simulated_scans(33, FRAMES, streets=CROWDED), force=True)
    replay = IncludeLaunchDescription(PythonLaunchDescriptionSource(str(LAUNCH)), launch_arguments={
        "bag": str(FOLDER / "drive"), "scores": str(FOLDER / "scores.json"), "loop": "true",
    }.items())
    return LaunchDescription([replay, launch_testing.actions.ReadyToTest()])


class TestReplay(unittest.TestCase):
    def test_candidates_arrive(self):
        rclpy.init()
        node = rclpy.create_node("listener")
        heard = []
        node.create_subscription(MarkerArray, result_topics()["final"], heard.append, 10)
        end = monotonic() + TIMEOUT
        while len(heard) < 2 * FRAMES and monotonic() < end:
            rclpy.spin_once(node, timeout_sec=0.1)
        node.destroy_node()
        rclpy.try_shutdown()
        assert len(heard) >= 2 * FRAMES  # the bag is played in a loop
        assert any(m.type == m.CUBE and m.action == m.ADD for a in heard for m in a.markers)


@launch_testing.post_shutdown_test()
class TestAfterwards(unittest.TestCase):
    def test_all_nodes_ended_with_code_0(self, proc_info):
        launch_testing.asserts.assertExitCodes(proc_info)
        assert set(STAGES) | {"bag_player", "evaluator"} <= {
            name.split("-")[0] for name in proc_info.process_names()}

    def test_the_scores_are_written(self):
        content = json.loads((FOLDER / "scores.json").read_text())
        assert content["frames"] > 0 and content["final"]["all"]["tp"] > 0
