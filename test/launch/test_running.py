"""Every launch file with its nodes: results are published, the bag is scored, and all nodes exit with 0.

`ros2 launch` runs the files if launch_ros is installed, otherwise launch_stand_in.py.
"""

from __future__ import annotations

import importlib.util
import json
import re

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from launch_stand_in import STOP_TIMEOUT_S, Launch, install
from ros_samples import CLOUD, MARKERS

from lidar_perception.nodes.graph import find_result_node
from lidar_perception.testing.clouds import make_cloud_message

HAS_LAUNCH = importlib.util.find_spec("launch_ros") is not None


@pytest.fixture
def launch(processes, peer, monkeypatch):
    """Return a function that starts a launch file and returns a function that waits for its end."""

    def start(name, **arguments):
        if HAS_LAUNCH:
            words = [f"{key}:={value}" for key, value in arguments.items()]
            processes.run("launch", ["ros2", "launch", "lidar_perception", f"{name}.launch.py", *words])
            return lambda: peer.wait(lambda: processes.has_ended("launch"), "the end")
        install(monkeypatch)
        launch = Launch(name, {key: str(value) for key, value in arguments.items()})
        launch.start(processes)
        return lambda: launch.run(processes, peer.wait)

    yield start
    codes = processes.stop(STOP_TIMEOUT_S)
    if HAS_LAUNCH:
        assert not re.findall("process has died.*", processes.read_log("launch"))
    else:
        assert {*codes.values()} == {0}, codes


def street():
    points = np.random.default_rng(0).uniform(-20, 20, (5000, 3))
    points[:, 2] = -1.73
    return points


@pytest.mark.parametrize(
    ("name", "arguments", "detectors"),
    [
        ("perception", {}, ["candidates"]),
        ("pointpillars", {}, ["pointpillars"]),
        ("pointnet", {"processes": "true"}, ["pointnet"]),
        ("fused", {"single": "true"}, ["fused"]),
        (
            "detectors",
            {"detectors": "pointpillars,candidates", "processes": "false", "tracking": "true"},
            ["pointpillars", "candidates"],
        ),
    ],
)
def test_detectors_publish_a_result_for_a_cloud(name, arguments, detectors, launch, peer):
    launch(name, points="/lidar/points", **arguments)
    single = arguments.get("single") == "true"
    results = [
        peer.listen(f"/{find_result_node(detector, single)}/output/detections", MARKERS) for detector in detectors
    ]
    peer.send(
        peer.advertise("/lidar/points", CLOUD),
        make_cloud_message(street(), 10**9, "lidar"),
        lambda: all(results),
        "detections of all detectors",
    )
    assert {m.header.frame_id for found in results for a in found for m in a.markers} == {"lidar"}


def test_two_lidars_have_separate_results(launch, peer):
    launch("two_lidars", left="/lidar_left", detectors="candidates")
    results = {
        side: peer.listen(f"/{side}/candidate_refinement/output/detections", MARKERS) for side in ("left", "right")
    }
    for side, topic in ("left", "/lidar_left"), ("right", "/right/points"):
        peer.send(
            peer.advertise(topic, CLOUD),
            make_cloud_message(street(), 10**9, side),
            lambda s=side: results[s],
            f"the result of {side}",
        )
    for side, found in results.items():
        assert {m.header.frame_id for array in found for m in array.markers} == {side}


@pytest.mark.parametrize("detectors", ["candidates", "fused,pointpillars"])
def test_replay_scores_the_detectors_of_a_bag(detectors, launch, drive_bag, tmp_path):
    file = tmp_path / "scores.json"
    launch("replay", bag=drive_bag, detectors=detectors, scores=file)()
    content = json.loads(file.read_text())
    assert content["frames"] > 0
    if detectors == "candidates":
        assert content["final"]["all"]["tp"] > 0 and content["classes"] == {}
        return
    for name in detectors.split(","):
        assert content[name]["all"]["tp"] > 0
        assert content["classes"]["Cyclist"][name]["all"]["tp"] > 0
        assert {*content["ap"][name]} == {"Car", "Pedestrian", "Cyclist"}
        assert content["ap"][name]["Pedestrian"]["bev_relaxed"]["moderate"]["r40"] > 0
