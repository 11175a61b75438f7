"""launch/two_lidars.launch.py: each sensor's clouds give its own results, all end with 0.

Runs where launch_testing is installed (a full ROS 2); test_reception.py tests the same with plain
processes everywhere.
"""

from __future__ import annotations

import unittest

import numpy as np
import pytest

pytest.importorskip("launch_testing", reason="needs launch_testing, which comes with ROS 2")
pytest.importorskip("launch_ros", reason="needs launch_ros, which comes with ROS 2")

import launch_testing
import launch_testing.asserts

from lidar_perception.nodes.graph import STAGES
from lidar_perception.testing.clouds import make_cloud_message
from lidar_perception.testing.launching import include_launch_file, make_description
from lidar_perception.testing.peer import Peer

SIDES = {"left": "/lidar_left", "right": "/right/points"}  # where their clouds come from


@pytest.mark.launch_test
def generate_test_description():
    return make_description(include_launch_file("two_lidars", left=SIDES["left"]))


class TestTwoLidars(unittest.TestCase):
    def test_each_has_its_own_results(self):
        street = np.random.default_rng(0).uniform(-20, 20, (5000, 3))
        street[:, 2] = -1.73
        with Peer() as peer:
            heard = {side: peer.listen(f"/{side}/candidate_refinement/output/detections",
                                       "visualization_msgs/msg/MarkerArray") for side in SIDES}
            for side, topic in SIDES.items():
                peer.send(peer.advertise(topic, "sensor_msgs/msg/PointCloud2"),
                          make_cloud_message(street, 10**9, side), lambda s=side: heard[s],
                          f"the result of {side}")
        for side, messages in heard.items():
            assert {m.header.frame_id for a in messages for m in a.markers} == {side}


@launch_testing.post_shutdown_test()
class TestAfterwards(unittest.TestCase):
    def test_all_nodes_ended_with_code_0(self, proc_info):
        launch_testing.asserts.assertExitCodes(proc_info)
        assert sorted(name.split("-")[0] for name in proc_info.process_names()) == sorted(
            2 * list(STAGES))
