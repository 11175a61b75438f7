"""launch/replay.launch.py with a bag made here: candidates come, the bag is scored, all end with 0.

Runs where launch_testing is installed (a full ROS 2); test_graph.py tests the same scenario
with plain processes everywhere.
"""

from __future__ import annotations

import json
import tempfile
import unittest
from pathlib import Path

import pytest

pytest.importorskip("launch_testing", reason="needs launch_testing, which comes with ROS 2")
pytest.importorskip("launch_ros", reason="needs launch_ros, which comes with ROS 2")

import launch_testing
import launch_testing.asserts

from lidar_perception.nodes.graph import STAGES, list_result_topics
from lidar_perception.simulation.recording import simulate_frames
from lidar_perception.simulation.scene import CROWDED_ZONES
from lidar_perception.testing.bags import write_rosbags_bag
from lidar_perception.testing.detections import to_objects
from lidar_perception.testing.launching import include_launch_file, make_description
from lidar_perception.testing.peer import Peer

FOLDER = Path(tempfile.mkdtemp())
FRAMES = 6


@pytest.mark.launch_test
def generate_test_description():
    bag = write_rosbags_bag(FOLDER / "drive", simulate_frames(33, FRAMES, scenes=CROWDED_ZONES))
    return make_description(include_launch_file("replay", bag=bag, scores=FOLDER / "scores.json",
                                                loop=True))


class TestReplay(unittest.TestCase):
    def test_candidates_arrive(self):
        """The bag is played in a loop."""
        with Peer() as peer:
            heard = peer.wait_for_messages(list_result_topics()["final"],
                                           "visualization_msgs/msg/MarkerArray", 2 * FRAMES)
        assert any(len(to_objects(message).boxes) for message in heard)


@launch_testing.post_shutdown_test()
class TestAfterwards(unittest.TestCase):
    def test_all_nodes_ended_with_code_0(self, proc_info):
        launch_testing.asserts.assertExitCodes(proc_info)
        assert set(STAGES) | {"bag_player", "evaluator"} <= {
            name.split("-")[0] for name in proc_info.process_names()}

    def test_the_scores_are_written(self):
        content = json.loads((FOLDER / "scores.json").read_text())
        assert content["frames"] > 0 and content["final"]["all"]["tp"] > 0
