"""Launch rejects unknown arguments before any node starts.

Runs where ROS 2's launch is installed; test_launch_files.py has stand-ins for it.
"""

from __future__ import annotations

import pytest

pytest.importorskip("launch_ros", reason="needs launch_ros, which comes with ROS 2")

from launch.actions import SetLaunchConfiguration

from launch import LaunchDescription, LaunchService
from lidar_perception.testing.launching import include_launch_file

NOTHING_STARTS = {"detectors": "dream"}


@pytest.mark.parametrize(
    "name, given, words",
    [
        ("fused", {"pionts": "/cloud"}, "unknown launch argument 'pionts'; did you mean 'points'?"),
        ("two_lidars", {"fused.scores.car": "0.7"}, "a parameter of fused_detector"),
        ("fused", {"launch-prefix": ""}, "'dream' is unknown"),
    ],
)
def test_unknown_launch_argument_is_rejected(name, given, words, capfd):
    """Launch configurations of an including file are not arguments of the included one."""
    service = LaunchService(noninteractive=True)
    service.include_launch_description(
        LaunchDescription(
            [SetLaunchConfiguration("map", "office"), include_launch_file(name, **NOTHING_STARTS, **given)]
        )
    )
    assert service.run() == 1
    assert words in "".join(capfd.readouterr())
