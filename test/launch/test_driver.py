"""launch/perception.launch.py with a driver of another package, which does not use the package's Fast DDS
profile: every cloud is processed or counted, candidates are published, and all processes exit with 0.

Runs where launch_testing is installed (a full ROS 2); test_reception.py tests the same with plain
processes everywhere.
"""

from __future__ import annotations

import os
import subprocess
import sys
import unittest
from pathlib import Path

import pytest

pytest.importorskip("launch_testing", reason="needs launch_testing, which comes with ROS 2")
pytest.importorskip("launch_ros", reason="needs launch_ros, which comes with ROS 2")

import launch_testing
import launch_testing.asserts

from lidar_perception.nodes.shared_memory import PROFILE_VARIABLES
from lidar_perception.testing.launching import include_launch_file, make_description
from lidar_perception.testing.peer import Peer

DRIVER = Path(__file__).resolve().parents[1] / "ros" / "driver.py"
COUNT, POINTS = 20, 130_000  # clouds of 2 MB


@pytest.mark.launch_test
def generate_test_description():
    return make_description(include_launch_file("perception", points="/driver_points", single=True))


class TestDriver(unittest.TestCase):
    def test_every_cloud_is_processed_or_counted_as_dropped(self):
        environment = {k: v for k, v in os.environ.items() if k not in PROFILE_VARIABLES}
        numbers = map(str, (COUNT, 10, POINTS, 1))
        driver = subprocess.Popen(
            [sys.executable, DRIVER, "/driver_points", "reliable", *numbers],
            env=environment,
            stdin=subprocess.PIPE,
            text=True,
        )
        with Peer() as peer:

            def value(key):
                return int(peer.get_value("perception", key) or 0)

            found = peer.listen("/perception/output/detections", "visualization_msgs/msg/MarkerArray")
            peer.wait(lambda: found and value("frames") + value("dropped") == COUNT, "every cloud")
            assert value("lost") == 0
            assert peer.get_value("perception", "reliability") == "reliable"
        driver.communicate("\n", timeout=20)
        assert driver.returncode == 0


@launch_testing.post_shutdown_test()
class TestAfterwards(unittest.TestCase):
    def test_all_nodes_exit_with_0(self, proc_info):
        launch_testing.asserts.assertExitCodes(proc_info)
        assert [name.split("-")[0] for name in proc_info.process_names()] == ["perception"]
