"""The network detectors as processes, compared with the offline detectors with the same weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from detection_samples import make_random_network, make_tiny_config
from detector_node import (
    FUSED_NODE,
    POINTNET_NODE,
    POINTPILLARS_NODE,
    REMAP,
    assert_equal,
    find_received,
    make_scan_message,
    small_v4,
)
from rcl_interfaces.srv import DescribeParameters
from ros_samples import BAD, CLOUD

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import segment_cloud
from lidar_perception.cli.options import read_config
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.detectors.checkpoint import Header, read_header, save_checkpoint
from lidar_perception.detectors.fused.fusion import find_fused_weights
from lidar_perception.detectors.fused.params import FusedParams
from lidar_perception.detectors.normalized_view import NormalizedView, segment_view_ground
from lidar_perception.detectors.pointpillars.config import AHEAD, RANGES, NetworkConfig
from lidar_perception.ground.segment import segment_ground
from lidar_perception.nodes.fused_detector import FusedNode
from lidar_perception.nodes.ground_segmentation import GroundSegmentation
from lidar_perception.nodes.main import run
from lidar_perception.param_fields import with_values
from lidar_perception.testing.processes import NodesUnderTest
from lidar_perception.wire.codec import decode
from lidar_perception.wire.messages import IN_VIEW, read_column, to_point_cloud
from lidar_perception.wire.topics import POINTS
from msg_utils.markers import from_marker_array
from msg_utils.point_cloud2 import to_array

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(
    scope="module", params=[POINTPILLARS_NODE, POINTNET_NODE, FUSED_NODE], ids=lambda tested: tested.network
)
def tested(request):
    return request.param


@pytest.fixture(scope="module")
def shared_processes(tested, domain, tmp_path_factory):
    """The nodes of one detector; they are stopped before those of the next one start."""
    with NodesUnderTest(tmp_path_factory.mktemp("logs"), domain) as processes:
        yield processes


@pytest.fixture(scope="module")
def peer(shared_peer):
    return shared_peer


@pytest.fixture(scope="module")
def weights(tested, tmp_path_factory) -> Path:
    return tested.make_weights(tmp_path_factory.mktemp("weights"))


@pytest.fixture(scope="module")
def segmented_cloud(tested):
    """Ground and clusters of make_scan_message(1) from the nodes before the detector."""
    params = with_values(PipelineParams(), read_config(tested.stages, PipelineParams()))
    return segment_cloud(to_point_cloud(make_scan_message(1), 0.0)[0], None, params)


def test_detections_equal_those_of_offline_detector(tested, graph_detections, talker, peer, weights, segmented_cloud):
    """One cloud passes the complete graph; one without columns is sent directly to the detector."""
    points = peer.listen(tested.between, CLOUD)
    times = {step: peer.listen(f"/{tested.node}/debug/{step}_ms", "std_msgs/msg/Float64") for step in tested.steps}
    peer.wait_for_diagnostics(tested.node, "waiting for input")
    scan = to_point_cloud(make_scan_message(1), 0.0)[0]
    if len(tested.graph) > 1:
        peer.send(
            peer.advertise(POINTS, CLOUD),
            make_scan_message(1),
            lambda: points and find_received(graph_detections, 1),
            "detections",
        )
        assert segmented_cloud.ground.any() and segmented_cloud.cluster_ids.max() >= 2
        indices = np.arange(len(scan))
        np.testing.assert_array_equal(read_column(points[-1], "cluster_id", indices), segmented_cloud.cluster_ids)
        np.testing.assert_array_equal(read_column(points[-1], "ground", indices) > 0, segmented_cloud.ground)
        assert_equal(
            find_received(graph_detections, 1),
            tested.offline(
                weights, make_scan_message(1), ground=segmented_cloud.ground, cluster_ids=segmented_cloud.cluster_ids
            ),
        )
        assert find_received(graph_detections, 1).frame_id == "lidar"

    plain = tested.offline(weights, make_scan_message(2))
    peer.send(talker, make_scan_message(2), lambda: find_received(graph_detections, 2), "detections of a plain cloud")
    objects = find_received(graph_detections, 2)
    assert_equal(objects, plain)
    for i, extra in enumerate(objects.extras if plain.sources else []):
        assert extra["sources"] == {
            name: pytest.approx(scores[i], abs=1e-3) for name, scores in plain.sources.items() if np.isfinite(scores[i])
        }
        assert extra["sources"]["network"] > 0
    peer.wait(lambda: all(times.values()), "the times of the steps")
    assert all(values[-1].data >= 0 for values in times.values())
    peer.wait(lambda: peer.get_value(tested.node, "detections"), "counts")
    network = peer.get_value(tested.node, "network")
    assert network.startswith(tested.title) and (tested is not FUSED_NODE or "PointNet" in network)


def test_columns_of_the_cloud_replace_own_segmentation(tested, graph_detections, talker, peer, weights):
    scan = to_point_cloud(make_scan_message(1), 0.0)[0]
    no_ground = np.zeros(len(scan), np.uint8)
    ids = cluster_obstacles(scan.xyz, no_ground > 0, tested.params.clustering)
    peer.send(
        talker,
        make_scan_message(3, ground=no_ground, cluster_id=ids.astype(np.uint32)),
        lambda: find_received(graph_detections, 3),
        "detections of a cloud with columns",
    )
    expected = tested.offline(weights, make_scan_message(3), ground=no_ground > 0, cluster_ids=ids)
    assert_equal(find_received(graph_detections, 3), expected)
    plain = tested.offline(weights, make_scan_message(2))
    assert not (np.array_equal(expected.boxes, plain.boxes) and np.array_equal(expected.scores, plain.scores))


def test_bad_clouds_are_reported_and_the_node_continues(
    tested, talker, graph_detections, shared_processes, peer, weights
):
    bad = {**{name: bad for name, bad in BAD.items() if name != "one point"}, **tested.bad_clouds()}
    for name, (msg, words) in bad.items():
        peer.diagnostics.clear()
        peer.send(talker, msg, lambda w=words: w in peer.get_message(tested.node), f"'{words}': {name}")
    peer.send(talker, make_scan_message(7), lambda: find_received(graph_detections, 7), "detections of a good cloud")
    assert_equal(find_received(graph_detections, 7), tested.offline(weights, make_scan_message(7)))
    log = shared_processes.read_log(tested.node)
    assert "Traceback" not in log and "Warning" not in log


def test_only_thresholds_can_change_at_run_time(tested, talker, graph_detections, peer):
    network = tested.network
    for name, value, words in [
        (f"{network}.weights", "other.safetensors", "read-only"),
        (f"{network}.device", "cuda", "read-only"),
        (f"{network}.scores.car", 1.5, ""),
        ("ground.method", "dream", "patchwork"),
    ]:
        (reason,) = peer.set_parameters(f"/{tested.node}", {name: value})
        assert reason and words in reason
    (described,) = peer.call(
        f"/{tested.node}/describe_parameters",
        DescribeParameters,
        DescribeParameters.Request(names=[f"{network}.scores.car"]),
    ).descriptors
    assert described.floating_point_range[0].to_value == 1.0 and "Car" in described.description

    names = [k for k in tested.values(Path("w")) if k.startswith(f"{network}.scores.")]
    with peer.override_parameters(f"/{tested.node}", dict.fromkeys(names, 1.0)):
        peer.send(
            talker, make_scan_message(12), lambda: find_received(graph_detections, 12) is not None, "no detections"
        )
        assert len(find_received(graph_detections, 12)) == 0
        peer.wait(lambda: "threshold" in peer.get_message(tested.node), "the reason")
        if tested is not FUSED_NODE:
            peer.wait(lambda: "Car 0." in (peer.get_value(tested.node, "best scores") or ""), "the scores")
    if tested is POINTPILLARS_NODE:
        with peer.override_parameters(f"/{tested.node}", {"ground.sensor_pose.height": 1.2}):
            peer.send(
                talker,
                make_scan_message(13),
                lambda: "ground.sensor_pose.height is 1.2" in peer.get_message(tested.node),
                "the wrong height",
            )


def use_other_version(folder):
    path = folder / "v0.safetensors"
    save_checkpoint(path, make_random_network(make_tiny_config("v0")), Header(make_tiny_config("v0")))
    return {"pointpillars.weights": str(path), "pointpillars.version": "auto"}


def use_nan_weights(folder):
    network = make_random_network(make_tiny_config("v0"))
    network.head.scores.bias.fill_(np.nan)
    save_checkpoint(folder / "nan.safetensors", network, Header(make_tiny_config("v0")))
    return {"pointpillars.weights": str(folder / "nan.safetensors")}


def find_unshipped_version():
    """Version and size of a PointPillars whose weights are not shipped, or None."""
    from lidar_perception.detectors.weights_file import POINTPILLARS_WEIGHTS

    return next(
        (
            (v, size)
            for v in ("v4", "v3", "v2", "v1", "v0")
            for size in ("compact", "full")
            if not (POINTPILLARS_WEIGHTS / f"pointpillars_{v}_{size}.safetensors").is_file()
        ),
        None,
    )


UNSHIPPED = find_unshipped_version()
MISSING = "checkpoint not found: /nowhere.safetensors"
UNUSABLE = {  # by detector: function that makes parameters, level, words; more in test_weights.py
    POINTPILLARS_NODE.node: [
        (lambda folder: {"pointpillars.weights": "/nowhere.safetensors"}, 2, MISSING),
        (
            lambda folder: {
                **use_other_version(folder),
                "pointpillars.device": "cuda:99",
                "pointpillars.cpu_fallback": False,
            },
            2,
            "'cuda:99' is not available",
        ),
        (lambda folder: {**use_other_version(folder), "pointpillars.device": "cuda:99"}, 1, "falling back to the CPU"),
        (use_nan_weights, 1, "scores are NaN"),
        *[
            (
                lambda folder, v=version, s=size: {"pointpillars.version": v, "pointpillars.size": s},
                2,
                f"no weights for {version} {size}",
            )
            for version, size in ([UNSHIPPED] if UNSHIPPED else [])
        ],
    ],
    POINTNET_NODE.node: [
        (lambda folder: {"pointnet.weights": "/nowhere.safetensors"}, 2, MISSING),
        (lambda folder: {"pointnet.weights": str(folder / (300 * "a"))}, 2, "File name too long"),
        (lambda folder: {"pointnet.weights": str(small_v4(folder))}, 2, "contains a PointPillars network for"),
    ],
    FUSED_NODE.node: [(lambda folder: {"fused.weights": "/nowhere.safetensors"}, 2, MISSING)],
}


def test_unusable_weights_are_reported_in_diagnostics(tested, shared_processes, peer, tmp_path):
    cases = UNUSABLE[tested.node]
    for i, (make, _, words) in enumerate(cases):
        shared_processes.fresh = words == MISSING
        shared_processes.start(tested.node, REMAP, make(tmp_path), f"bad{i}")
    talker = peer.advertise("/in", CLOUD)
    for i, (_, level, words) in enumerate(cases):
        node, log = f"bad{i}/{tested.node}", f"bad{i}.{tested.node}"
        peer.send(talker, make_scan_message(1), lambda n=node, w=words: w in peer.get_message(n), words)
        assert ord(peer.diagnostics[node].level) == level
        peer.diagnostics.clear()
        peer.wait(lambda n=node, w=words: w in peer.get_message(n), "the diagnostic again")
        assert not shared_processes.has_ended(log)
        assert "Traceback" not in shared_processes.read_log(log)
        maps = Path(f"/proc/{shared_processes.running[log].pid}/maps")
        if words == MISSING and tested is not FUSED_NODE and maps.is_file():
            assert "libtorch" not in maps.read_text()  # loading torch takes seconds and 200 MB


def test_node_runs_own_detector_class(start_node, tmp_path, monkeypatch):
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
    node = start_node(
        FusedNode, **{"fused.weights": "own_fused:Posts", "ground.sensor_pose.height": 0.5, "fused.warm_up": False}
    )
    node.on_points(make_scan_message(1))
    found = from_marker_array(deserialize_message(node.sent["detections"][-1], MarkerArray))
    assert found.labels == ["Pedestrian"] and found.boxes[0, 5] == pytest.approx(0.5)
    assert node.diagnostics.counts["network"] == "own_fused:Posts, Pedestrian"


@pytest.mark.parametrize(
    "node, words",
    [
        (POINTPILLARS_NODE.node, "pointpillars.scores.pedestrian (default 0.4)"),
        (POINTNET_NODE.node, "pointnet.min_points (default 3)"),
    ],
)
def test_help_lists_parameters(node, words, capsys):
    assert run(node, [node, "--help"]) == 0
    assert words in capsys.readouterr().out


@pytest.mark.parametrize("range", ["ahead", "around"])
def test_expert_nodes_segment_the_points_of_the_detector(start_node, range):
    """The ground equals that of the detector, and the published parts contain all points of the cloud."""
    node = start_node(GroundSegmentation, range=range, **{"ground.method": "patchwork"})
    assert read_header(find_fused_weights(FusedParams()), NetworkConfig).config.low == AHEAD["low"]
    cloud = make_scan_message(1)
    node.nonground.publisher.get_subscription_count = lambda: 1
    node.on_points(cloud)
    got, rest = (decode(node.sent[name][0], CLOUD) for name in ("points", "nonground"))
    indices = np.flatnonzero(to_array(got)["in_view"] == IN_VIEW)
    np.testing.assert_array_equal(to_point_cloud(got)[1], to_point_cloud(cloud)[1])
    whole, everything = to_point_cloud(cloud, 0.0)
    view = NormalizedView.of(whole, node.params.ground.sensor_pose, **RANGES[range])
    np.testing.assert_array_equal(indices, everything[view.indices])
    np.testing.assert_array_equal(
        read_column(got, "ground", indices) > 0, segment_view_ground(view.frame, node.params.ground)
    )
    assert rest.width == (~segment_ground(whole, node.params.ground)).sum()
