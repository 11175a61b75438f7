"""pointpillars_detector as a real process, against the offline detector with the same weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from detection_samples import eager, frame, lively, tiny
from detector_node import REMAP, DetectorUnderTest, assert_equal, message, received, small_v4
from rcl_interfaces.srv import DescribeParameters
from test_bad_input import BAD, CLOUD, MARKERS, cloud

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import segment_cloud
from lidar_perception.cli.options import read_config
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.detectors.checkpoint import Header, save_checkpoint
from lidar_perception.detectors.pointpillars.detector import STEPS, load_detector
from lidar_perception.detectors.pointpillars.params import DetectorParams
from lidar_perception.nodes.graph import POINTPILLARS
from lidar_perception.nodes.main import run
from lidar_perception.param_fields import with_values
from lidar_perception.wire.messages import read_column, to_point_cloud
from lidar_perception.wire.topics import POINTS

NODE = "pointpillars_detector"
EXPERTS = Path(__file__).resolve().parents[2] / "config" / "pointpillars.param.yaml"
DETECTOR = DetectorUnderTest(NODE, POINTPILLARS, EXPERTS, eager(), load_detector)
BETWEEN, offline = DETECTOR.between, DETECTOR.offline

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    return small_v4(tmp_path_factory.mktemp("weights"))


@pytest.fixture(scope="module")
def peer(shared_peer):
    return shared_peer


def test_detections_over_dds_are_those_of_the_offline_detector(found, talker, peer, weights):
    """A cloud through all three, and a plain one straight to the detector, which then computes
    ground and clusters itself."""
    points = peer.listen(BETWEEN, CLOUD)
    times = {step: peer.listen(f"/{NODE}/debug/{step}_ms", "std_msgs/msg/Float64")
             for step in STEPS}
    peer.wait_for_diagnostics(NODE, "waiting for input")
    peer.send(peer.advertise(POINTS, CLOUD), message(1), lambda: points and received(found, 1),
              "detections")

    params = with_values(PipelineParams(), read_config(EXPERTS, PipelineParams()))
    scan = to_point_cloud(message(1), 0.0)[0]
    segmented = segment_cloud(scan, None, params)
    columns = {"ground": segmented.ground, "cluster_ids": segmented.cluster_ids}
    assert segmented.ground.any() and segmented.cluster_ids.max() >= 2
    marked, indices = points[-1], np.arange(len(scan))
    np.testing.assert_array_equal(read_column(marked, "ground", indices) > 0, segmented.ground)
    np.testing.assert_array_equal(read_column(marked, "cluster_id", indices), segmented.cluster_ids)
    assert_equal(received(found, 1), offline(weights, message(1), **columns))
    assert received(found, 1).frame_id == "lidar"

    peer.send(talker, message(2), lambda: received(found, 2), "detections of a plain cloud")
    assert_equal(received(found, 2), offline(weights, message(2)))
    # Columns that say something else are believed: no ground, and clusters of that.
    nowhere = np.zeros(len(scan), np.uint8)
    ids = cluster_obstacles(scan.xyz, nowhere > 0, DetectorParams().clustering)
    peer.send(talker, message(3, ground=nowhere, cluster_id=ids.astype(np.uint32)),
              lambda: received(found, 3), "detections of a cloud with columns")
    other = offline(weights, message(3), ground=nowhere > 0, cluster_ids=ids)
    assert_equal(received(found, 3), other)
    assert not np.array_equal(other.boxes, offline(weights, message(2)).boxes)

    peer.wait(lambda: all(times.values()), "the times of the steps")
    assert times["network"][-1].data > 0
    peer.wait(lambda: peer.get_value(NODE, "detections"), "counts")
    assert peer.get_value(NODE, "network").startswith("v4 compact")


def test_no_cloud_ends_the_detector_and_each_has_its_reason(talker, found, shared_processes, peer,
                                                            weights):
    xyz, rng = frame().xyz, np.random.default_rng(0)
    count = np.zeros(len(xyz))
    strange = {
        **{name: bad for name, bad in BAD.items() if name != "one point"},
        "one point": (cloud([[5, 0, -1]]), "no intensity"),
        "out of range": (cloud(xyz + [500, 0, 0]), "network's range"),
        "behind": (cloud(np.abs(xyz) * [-1, 1, -1] - [1, 0, 0]), "network's range"),
        "no intensity": (cloud(xyz), "no intensity"),
        "a million": (cloud(rng.uniform(-50, 50, (1_000_000, 3)) * [1, 1, 0.05]), "no intensity"),
        "NaN among them": (cloud(np.where(np.arange(len(xyz))[:, None] % 3, xyz, np.nan)),
                           "no intensity"),
        "all is ground": (message(1, ground=count.astype("u1") + 1), "is ground"),
        "no clusters": (message(1, ground=count.astype("u1"), cluster_id=count.astype("u4")),
                        "detecting"),
        "numbers of another program": (message(1, cluster_id=(count + 2**32 - 1).astype("u4"),
                                               ground=count.astype("u1")), "detecting"),
        "large numbers": (message(1, cluster_id=(count + 2**31 - 1).astype("u4")), "detecting"),
        "columns of floats": (message(1, cluster_id=count * np.nan, ground=count * np.nan),
                              "detecting"),
        "two numbers a point": (message(1, ground=np.zeros((len(xyz), 2), "u1")),
                                "'ground' has count > 1"),
    }
    for name, (msg, words) in strange.items():
        peer.diagnostics.clear()
        peer.send(talker, msg, lambda w=words: w in peer.get_message(NODE), f"'{words}': {name}")
    peer.send(talker, message(7), lambda: received(found, 7), "detections of a good cloud")
    assert_equal(received(found, 7), offline(weights, message(7)))
    log = shared_processes.read_log(NODE)
    assert "Traceback" not in log and "Warning" not in log


def test_thresholds_change_at_run_time_and_what_cannot_is_refused(talker, found, peer):
    for name, value, words in [("pointpillars.weights", "other.safetensors", "read-only"),
                               ("pointpillars.device", "cuda", "read-only"),
                               ("pointpillars.version", "v0", "read-only"),
                               ("pointpillars.scores.car", 1.5, ""),
                               ("ground.method", "dream", "patchwork")]:
        reason, = peer.set_parameters(f"/{NODE}", {name: value})
        assert reason and words in reason
    described, = peer.call(f"/{NODE}/describe_parameters", DescribeParameters,
                           DescribeParameters.Request(names=["pointpillars.scores.car"])).descriptors
    assert described.floating_point_range[0].to_value == 1.0 and "Car" in described.description

    with peer.parameters(f"/{NODE}", {f"pointpillars.scores.{name}": 1.0
                                      for name in ("car", "pedestrian", "cyclist")}):
        peer.send(talker, message(12), lambda: received(found, 12) is not None, "no detections")
        assert len(received(found, 12)) == 0
        peer.wait(lambda: "below its threshold" in peer.get_message(NODE), "the reason")
        peer.wait(lambda: "Car 0." in (peer.get_value(NODE, "best scores") or ""), "the scores")
    with peer.parameters(f"/{NODE}", {"ground.sensor_pose.height": 1.2}):
        peer.send(talker, message(13), lambda: "ground.sensor_pose.height is 1.2"
                  in peer.get_message(NODE), "the wrong height")


def checkpoint_of_another_size(folder):
    path = folder / "v0.safetensors"
    save_checkpoint(path, lively(tiny("v0")), Header(tiny("v0")))
    return {"pointpillars.weights": str(path), "pointpillars.version": "v4"}


def broken_weights(folder):
    network = lively(tiny("v0"))
    network.head.scores.bias.fill_(np.nan)
    save_checkpoint(folder / "nan.safetensors", network, Header(tiny("v0")))
    return {"pointpillars.weights": str(folder / "nan.safetensors")}


UNUSABLE = {  # parameters made in a folder; level, words; test_weights.py has more, without ROS
    "nowhere": (lambda folder: {"pointpillars.weights": "/nowhere.safetensors"}, 2,
                "there is no checkpoint /nowhere.safetensors"),
    "no CUDA": (lambda folder: {**checkpoint_of_another_size(folder),
                                "pointpillars.version": "auto", "pointpillars.device": "cuda:99",
                                "pointpillars.cpu_fallback": False}, 2,
                "'cuda:99' is asked for"),
    "no CUDA, the CPU instead": (lambda folder: {
        **checkpoint_of_another_size(folder), "pointpillars.version": "auto",
        "pointpillars.device": "cuda:99"}, 1, "the CPU is used"),
    "NaN": (broken_weights, 1, "not numbers (NaN)"),
}


@pytest.fixture(scope="module")
def unusable(shared_processes, tmp_path_factory):
    """A node for each, in a namespace of its own, all started at once."""
    for i, (make, _, _) in enumerate(UNUSABLE.values()):
        shared_processes.start(NODE, REMAP, make(tmp_path_factory.mktemp("weights")), f"bad{i}")
    return {case: f"bad{i}/{NODE}" for i, case in enumerate(UNUSABLE)}


@pytest.fixture(scope="module")
def to_unusable(peer):
    return peer.advertise("/in", CLOUD)


@pytest.mark.parametrize("case", UNUSABLE)
def test_weights_that_cannot_be_used_are_a_diagnostic(case, unusable, to_unusable,
                                                      shared_processes, peer):
    (_, level, words), node = UNUSABLE[case], unusable[case]
    peer.send(to_unusable, message(1), lambda: words in peer.get_message(node), words)
    assert ord(peer.diagnostics[node].level) == level
    peer.diagnostics.clear()
    peer.wait(lambda: words in peer.get_message(node), "the diagnostic again")
    log = node.replace("/", ".")
    assert not shared_processes.has_ended(log) and "Traceback" not in shared_processes.read_log(log)


def test_without_weights_the_node_lives_says_so_and_finds_nothing(processes, shared_peer,
                                                                  to_unusable):
    from lidar_perception.detectors.pointpillars.weights_file import WEIGHTS
    missing = next((f"{v} {s}" for v in ("v4", "v3", "v2", "v1", "v0") for s in ("compact", "full")
                    if not (WEIGHTS / f"pointpillars_{v}_{s}.safetensors").is_file()), None)
    if missing is None:
        pytest.skip("weights of all versions and sizes come with the package")
    version, size = missing.split()
    processes.fresh = True
    processes.start(NODE, {"~/input/points": "/in"},
                    {"pointpillars.version": version, "pointpillars.size": size}, "none")
    peer, node = shared_peer, f"none/{NODE}"
    found = peer.listen(f"/{node}/output/detections", MARKERS)
    peer.send(to_unusable, message(1), lambda: f"no weights for {missing}" in
              peer.get_message(node), "the diagnostic")
    peer.diagnostics.clear()
    peer.wait(lambda: f"no weights for {missing}" in peer.get_message(node), "it again")
    assert not found and not processes.has_ended(f"none.{NODE}")
    maps = Path(f"/proc/{processes.running[f'none.{NODE}'].pid}/maps")
    if maps.is_file():
        assert "libtorch" not in maps.read_text()  # which takes seconds and 200 MB


def test_help_and_run_know_the_node(capsys):
    assert run(NODE, [NODE, "--help"]) == 0
    assert "pointpillars.scores.pedestrian (default 0.4)" in capsys.readouterr().out
