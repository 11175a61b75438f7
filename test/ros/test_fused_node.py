"""fused_detector as a real process, against the offline detector with the same weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from detection_samples import frame
from detector_node import DetectorUnderTest, assert_equal, message, received, small_v4
from test_bad_input import BAD, CLOUD, cloud

from lidar_perception.detectors.checkpoint import read_header
from lidar_perception.detectors.fused.detector import load_fused_detector
from lidar_perception.detectors.fused.fusion import load_shipped_models, weights_file, write_fusion
from lidar_perception.detectors.fused.params import STEPS, FusedDetectorParams, FusedParams
from lidar_perception.detectors.normalized_view import NormalizedView, segment_view_ground
from lidar_perception.detectors.pointpillars.config import AHEAD, RANGES, NetworkConfig
from lidar_perception.ground.segment import segment_ground
from lidar_perception.nodes.fused_detector import FusedNode
from lidar_perception.nodes.graph import build_graph
from lidar_perception.nodes.ground_segmentation import GroundSegmentation
from lidar_perception.param_fields import with_values
from lidar_perception.wire.codec import decode
from lidar_perception.wire.messages import IN_VIEW, read_column, to_point_cloud
from msg_utils.markers import from_marker_array
from msg_utils.point_cloud2 import to_array

NODE = "fused_detector"
FILE = Path(__file__).resolve().parents[2] / "config" / "fused.param.yaml"
EAGER = with_values(FusedDetectorParams(), {"fused.range": "around", **{
    f"fused.scores.{name}": 0.0 for name in ("car", "pedestrian", "cyclist", "other")}})
DETECTOR = DetectorUnderTest(NODE, build_graph(["fused"], single=True), FILE, EAGER,
                             load_fused_detector)

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    """A file of `train fused` of small weights, with curves of its own."""
    folder = tmp_path_factory.mktemp("weights")
    models = {name: {**model, "bias": model["bias"] + 1}
              for name, model in load_shipped_models().items()}
    write_fusion(folder / "fused.json", (small_v4(folder), None), models, {})
    return folder / "fused.json"


def test_detections_over_dds_are_those_of_the_offline_detector(found, talker, shared_peer, weights):
    times = {step: shared_peer.listen(f"/{NODE}/debug/{step}_ms", "std_msgs/msg/Float64")
             for step in STEPS}
    shared_peer.wait_for_diagnostics(NODE, "waiting for input")
    shared_peer.send(talker, message(1), lambda: received(found, 1), "detections")
    objects, offline = received(found, 1), DETECTOR.offline(weights, message(1))
    assert_equal(objects, offline)
    for i, extra in enumerate(objects.extras):  # which of the sources says what
        assert extra["sources"] == {name: pytest.approx(said[i], abs=1e-3) for name, said
                                    in offline.sources.items() if np.isfinite(said[i])}
        assert extra["sources"]["network"] > 0
    # Columns are believed, here those of a cloud that has no ground.
    none = np.zeros(len(frame()), np.uint8)
    shared_peer.send(talker, message(2, ground=none), lambda: received(found, 2), "detections")
    other = DETECTOR.offline(weights, message(2), ground=none > 0)
    assert_equal(received(found, 2), other)
    assert not np.array_equal(other.scores, DETECTOR.offline(weights, message(2)).scores)
    shared_peer.wait(lambda: all(times.values()), "the times of the steps")
    assert "PointNet" in shared_peer.get_value(NODE, "network")


def test_no_cloud_ends_the_detector(talker, found, shared_processes, shared_peer, weights):
    strange = {**{name: bad for name, bad in BAD.items() if name != "one point"},
               "out of range": (cloud(frame().xyz + [500, 0, 0]), "network's range"),
               "all is ground": (message(1, ground=np.ones(len(frame()), "u1")), "is ground")}
    for name, (msg, words) in strange.items():
        shared_peer.diagnostics.clear()
        shared_peer.send(talker, msg, lambda w=words: w in shared_peer.get_message(NODE),
                         f"'{words}': {name}")
    shared_peer.send(talker, message(7), lambda: received(found, 7), "detections of a good cloud")
    assert_equal(received(found, 7), DETECTOR.offline(weights, message(7)))
    log = shared_processes.read_log(NODE)
    assert "Traceback" not in log and "Warning" not in log


def test_node_runs_class_of_your_own(start, tmp_path, monkeypatch):
    (tmp_path / "own_fused.py").write_text("""
import lidar_perception as lp

class Posts:
    classes = ("Pedestrian",)
    def __init__(self, sensor_height):
        self.sensor_height = sensor_height
    def __call__(self, cloud):
        boxes = [[5, 0, 0, 1, 1, self.sensor_height, 0], [9, 0, 0, 1, 1, 1, 0]]
        return lp.Detections.of(boxes, "Pedestrian", [0.9, 0.2])
""")
    from rclpy.serialization import deserialize_message
    from visualization_msgs.msg import MarkerArray
    monkeypatch.syspath_prepend(tmp_path)
    node = start(FusedNode, **{"fused.weights": "own_fused:Posts",
                               "ground.sensor_pose.height": 0.5, "fused.warm_up": False})
    node.on_points(message(1))
    found = from_marker_array(deserialize_message(node.sent["detections"][-1], MarkerArray))
    assert found.labels == ["Pedestrian"] and found.boxes[0, 5] == pytest.approx(0.5)
    assert node.counts["network"] == "own_fused:Posts, Pedestrian"


@pytest.mark.parametrize("range", ["ahead", "around"])
def test_experts_segment_the_points_that_the_detector_reads(start, range):
    """Ground as the detector computes it; the parts of the cloud have all its points."""
    node = start(GroundSegmentation, range=range, **{"ground.method": "patchwork"})
    assert read_header(weights_file(FusedParams()), NetworkConfig).config.low == AHEAD["low"]
    cloud = message(1)
    node.nonground.publisher.get_subscription_count = lambda: 1
    node.on_points(cloud)
    got, rest = (decode(node.sent[name][0], CLOUD) for name in ("points", "nonground"))
    indices = np.flatnonzero(to_array(got)["in_view"] == IN_VIEW)
    np.testing.assert_array_equal(to_point_cloud(got)[1], to_point_cloud(cloud)[1])
    whole, everything = to_point_cloud(cloud, 0.0)
    view = NormalizedView.of(whole, node.params.ground.sensor_pose, **RANGES[range])
    np.testing.assert_array_equal(indices, everything[view.indices])
    np.testing.assert_array_equal(read_column(got, "ground", indices) > 0,
                                  segment_view_ground(view.frame, node.params.ground))
    assert rest.width == (~segment_ground(whole, node.params.ground)).sum()
