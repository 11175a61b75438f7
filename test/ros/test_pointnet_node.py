"""pointnet_detector as a real process, against the offline detector with the same weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from detection_samples import frame
from detection_samples import lively as lively_pointpillars
from detection_samples import tiny as tiny_pointpillars
from detector_node import REMAP, DetectorUnderTest, assert_equal, message, received
from pointnet_samples import eager, lively, small
from test_bad_input import BAD, CLOUD, MARKERS, cloud

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import segment_cloud
from lidar_perception.cli.options import read_config
from lidar_perception.detectors.checkpoint import Header, save_checkpoint
from lidar_perception.detectors.checkpoint import Header as PointPillarsHeader
from lidar_perception.detectors.pointnet.detector import load_pointnet_detector
from lidar_perception.detectors.pointnet.params import STEPS
from lidar_perception.nodes.graph import POINTNET
from lidar_perception.nodes.main import run
from lidar_perception.param_fields import with_values
from lidar_perception.wire.messages import read_column, to_point_cloud
from lidar_perception.wire.topics import POINTS

NODE = "pointnet_detector"
SHARED = Path(__file__).resolve().parents[2] / "config" / "pointnet.param.yaml"
DETECTOR = DetectorUnderTest(NODE, POINTNET, SHARED, eager(), load_pointnet_detector)
BETWEEN, offline = DETECTOR.between, DETECTOR.offline

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    """Those of a small network at random, which finds something."""
    path = tmp_path_factory.mktemp("weights") / "pointnet.safetensors"
    save_checkpoint(path, lively(small()), Header(small()))
    return path


@pytest.fixture(scope="module")
def peer(shared_peer):
    return shared_peer


def test_detections_over_dds_are_those_of_the_offline_detector(found, talker, peer, weights):
    """A cloud through all three, and a plain one straight to the detector, which then finds ground
    and clusters itself."""
    points = peer.listen(BETWEEN, CLOUD)
    times = {step: peer.listen(f"/{NODE}/debug/{step}_ms", "std_msgs/msg/Float64")
             for step in STEPS}
    peer.wait_for_diagnostics(NODE, "waiting for input")
    peer.send(peer.advertise(POINTS, CLOUD), message(1), lambda: points and received(found, 1),
              "detections")
    scan = to_point_cloud(message(1), 0.0)[0]
    segmented = segment_cloud(scan, None, with_values(PipelineParams(),
                                                      read_config(SHARED, PipelineParams())))
    assert segmented.ground.any() and segmented.cluster_ids.max() >= 5
    np.testing.assert_array_equal(read_column(points[-1], "cluster_id", np.arange(len(scan))),
                                  segmented.cluster_ids)
    expected = offline(weights, message(1), cluster_ids=segmented.cluster_ids)
    assert_equal(received(found, 1), expected)
    assert received(found, 1).frame_id == "lidar"

    peer.send(talker, message(2), lambda: received(found, 2), "detections of a plain cloud")
    assert_equal(received(found, 2), expected)
    # Columns that say something else are believed.
    halves = segmented.cluster_ids * 2 + np.arange(len(scan)) % 2
    halves[segmented.cluster_ids == 0] = 0
    peer.send(talker, message(3, cluster_id=halves.astype(np.uint32)),
              lambda: received(found, 3), "detections of a cloud with clusters")
    other = offline(weights, message(3), cluster_ids=halves)
    assert_equal(received(found, 3), other)
    assert not np.array_equal(other.boxes, expected.boxes)

    peer.wait(lambda: all(times.values()), "the times of the steps")
    assert times["network"][-1].data > 0
    peer.wait(lambda: peer.get_value(NODE, "detections"), "counts")
    assert peer.get_value(NODE, "network").startswith("improved, Car")


def test_no_cloud_ends_the_detector_and_each_has_its_reason(talker, found, shared_processes, peer,
                                                            weights):
    count = np.zeros(len(frame()))
    strange = {
        **{name: bad for name, bad in BAD.items() if name != "one point"},
        "one point": (cloud([[5, 0, -1]]), "no clusters"),
        "all is ground": (message(1, ground=count.astype("u1") + 1), "no clusters"),
        "no clusters": (message(1, cluster_id=count.astype("u4")), "no clusters"),
        "clusters of one point": (message(1, cluster_id=np.arange(len(count), dtype="u4")),
                                  "fewer than 3 points"),
        "numbers of another program": (message(1, cluster_id=(count + 2**32 - 1).astype("u4")),
                                       "no clusters"),
        "one large cluster": (message(1, cluster_id=(count + 2**31 - 1).astype("u4")),
                              "detecting"),
        "a column of floats": (message(1, cluster_id=count * np.nan), "no clusters"),
        "no intensity": (cloud(frame().xyz), "no intensity"),
        "two numbers a point": (message(1, cluster_id=np.zeros((len(count), 2), "u4")),
                                "'cluster_id' has count > 1"),
    }
    for name, (msg, words) in strange.items():
        peer.diagnostics.clear()
        peer.send(talker, msg, lambda w=words: w in peer.get_message(NODE), f"'{words}': {name}")
    peer.send(talker, message(7), lambda: received(found, 7), "detections of a good cloud")
    assert_equal(received(found, 7), offline(weights, message(7)))

    with peer.parameters(f"/{NODE}", {f"pointnet.scores.{name}": 1.0
                                      for name in ("car", "pedestrian", "cyclist")}):
        peer.send(talker, message(8), lambda: received(found, 8) is not None, "no detections")
        assert len(received(found, 8)) == 0
        peer.wait_for_diagnostics(NODE, "threshold in pointnet.scores")
        peer.wait(lambda: "Car 0." in (peer.get_value(NODE, "best scores") or ""), "the scores")
    log = shared_processes.read_log(NODE)
    assert "Traceback" not in log and "Warning" not in log


def missing_weights(folder):
    return "/nowhere.safetensors"


def pointpillars_weights(folder):
    config = tiny_pointpillars()
    save_checkpoint(folder / "p.safetensors", lively_pointpillars(config),
                    PointPillarsHeader(config))
    return folder / "p.safetensors"


UNUSABLE = {  # weights made in a folder; words of the diagnostic
    "nowhere": (missing_weights, "there is no checkpoint /nowhere.safetensors"),
    "too long a name": (lambda folder: folder / (300 * "a"), "File name too long"),
    "PointPillars": (pointpillars_weights, "holds a PointPillars, which is for"),
}


def test_weights_that_cannot_be_used_are_a_diagnostic(shared_processes, peer, tmp_path):
    for i, (make, _) in enumerate(UNUSABLE.values()):
        shared_processes.fresh = make is missing_weights
        shared_processes.start(NODE, REMAP, {"pointnet.weights": str(make(tmp_path))}, f"bad{i}")
    talker, found = peer.advertise("/in", CLOUD), peer.listen("/found", MARKERS)
    for i, (make, words) in enumerate(UNUSABLE.values()):
        peer.send(talker, message(1), lambda n=f"bad{i}/{NODE}", w=words: w in peer.get_message(n),
                  words)
        assert ord(peer.diagnostics[f"bad{i}/{NODE}"].level) == 2 and not found
        node = f"bad{i}.{NODE}"
        maps = Path(f"/proc/{shared_processes.running[node].pid}/maps")
        if make is missing_weights and maps.is_file():
            assert "libtorch" not in maps.read_text()  # which takes seconds and 200 MB
        assert not shared_processes.has_ended(node)
        assert "Traceback" not in shared_processes.read_log(node)


def test_help_knows_the_node(capsys):
    assert run(NODE, [NODE, "--help"]) == 0
    assert "pointnet.min_points (default 3)" in capsys.readouterr().out
