"""Links between the nodes of one process."""

from __future__ import annotations

from signal import SIGINT
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile

from lidar_perception.data.bag import Bag
from lidar_perception.nodes.clustering import Clustering
from lidar_perception.nodes.external_node import create_context, shut_down_context
from lidar_perception.nodes.graph import build_graph
from lidar_perception.nodes.ground_segmentation import GroundSegmentation
from lidar_perception.nodes.interfaces import LATCHED, RELIABLE
from lidar_perception.nodes.links import Links, Output
from lidar_perception.nodes.replay.bag_recorder import BagRecorder
from lidar_perception.testing.clouds import make_cloud_message
from lidar_perception.types import Detections
from lidar_perception.wire.codec import decode, encode, make_bag_message
from lidar_perception.wire.messages import make_detection_rows
from msg_utils.markers import MarkerRows, from_marker_array
from msg_utils.messages import load_message_class
from msg_utils.stamps import make_header

CLOUD, MARKERS = "sensor_msgs/msg/PointCloud2", "visualization_msgs/msg/MarkerArray"
GROUND_POINTS = "/ground_segmentation/output/points"
CLUSTERING_INPUT = ["--ros-args", "-r", f"~/input/points:={GROUND_POINTS}"]


def make_cloud(stamp_ns=10**18):
    points = np.random.default_rng(0).uniform(-20, 20, (2000, 4)) * [1, 1, 0.01, 0.02]
    return make_cloud_message(points - [0, 0, 1.7, -0.5], stamp_ns)


@pytest.fixture
def linked_nodes(domain):
    """Ground segmentation and clustering, linked, and a function that spins both."""
    context, links = create_context(domain), Links()
    ground = GroundSegmentation(context=context, links=links)
    clustering = Clustering(context=context, links=links, cli_args=CLUSTERING_INPUT)
    executor = SingleThreadedExecutor(context=context)
    for node in (ground, clustering):
        node.start()
        executor.add_node(node)

    def spin(times=20):
        for _ in range(times):
            executor.spin_once(timeout_sec=0.01)

    yield SimpleNamespace(
        ground=ground, clustering=clustering, spin=spin, context=context, reception=clustering.inputs.receptions[0]
    )
    executor.shutdown()
    shut_down_context(context, ground, clustering)


def test_linked_nodes_pass_messages_without_dds(linked_nodes, monkeypatch):
    assert linked_nodes.reception.subscription is None
    assert linked_nodes.ground.points.get_subscription_count() == 1
    sent, received = [], []
    monkeypatch.setattr(linked_nodes.ground.points.publisher, "publish", sent.append)
    monkeypatch.setattr(linked_nodes.reception, "deliver", lambda msg, _: received.append(msg))
    linked_nodes.ground.on_points(cloud := make_cloud())
    linked_nodes.spin()
    (message,) = received
    assert message.header is cloud.header and not sent
    linked_nodes.ground.create_subscription(load_message_class(CLOUD), GROUND_POINTS, lambda _: None, RELIABLE)
    linked_nodes.spin()
    linked_nodes.ground.on_points(cloud)
    assert sent == [encode(message)]
    assert linked_nodes.reception.values() == {"lost": 0, "dropped": 0, "reliability": "in this process"}


def test_only_the_newest_linked_message_is_kept(linked_nodes, monkeypatch):
    received = []
    monkeypatch.setattr(linked_nodes.reception, "deliver", lambda msg, _: received.append(msg))
    linked_nodes.ground.on_points(make_cloud(10**18))
    linked_nodes.spin()
    for i in range(1, 10):
        linked_nodes.ground.on_points(make_cloud(10**18 + i))
    linked_nodes.spin()
    assert [m.header.stamp.nanosec for m in received] == [0, 9]
    assert linked_nodes.reception.arrivals.sent == 10 and linked_nodes.reception.arrivals.dropped == 8


def test_second_publisher_ends_the_link(linked_nodes, monkeypatch):
    other = linked_nodes.clustering.create_publisher(load_message_class(CLOUD), GROUND_POINTS, RELIABLE)
    linked_nodes.reception.adapt()
    assert linked_nodes.reception.subscription is not None and not linked_nodes.ground.points.receivers
    assert any("2 publishers" in text for _, _, text in linked_nodes.reception.problems())
    linked_nodes.clustering.destroy_publisher(other)
    linked_nodes.reception.adapt()
    assert linked_nodes.reception.subscription is None and linked_nodes.ground.points.receivers


def test_link_is_removed_and_restored_with_its_nodes(linked_nodes):
    assert linked_nodes.ground.points.receivers
    linked_nodes.clustering.trigger_deactivate()
    assert not linked_nodes.ground.points.receivers
    linked_nodes.clustering.trigger_activate()
    linked_nodes.ground.trigger_deactivate()
    linked_nodes.ground.trigger_cleanup()
    linked_nodes.spin()
    assert linked_nodes.reception.output is None and linked_nodes.reception.subscription is not None
    linked_nodes.ground.trigger_configure()
    linked_nodes.spin()
    assert linked_nodes.reception.output is linked_nodes.ground.points


def test_recorder_gets_linked_messages_without_dds(linked_nodes, monkeypatch, tmp_path):
    recorder = BagRecorder(
        context=linked_nodes.context,
        links=linked_nodes.ground.links,
        cli_args=["--ros-args", "-p", f"bag:={tmp_path}/bag", "-p", f"topics:=['{GROUND_POINTS}']"],
    )
    published = []
    monkeypatch.setattr(linked_nodes.ground.points.publisher, "publish", published.append)
    linked_nodes.ground.on_points(make_cloud())
    other = linked_nodes.clustering.create_publisher(load_message_class(CLOUD), GROUND_POINTS, RELIABLE)
    recorder._discover()  # with a second publisher, all messages come by DDS
    assert not recorder.link_by_topic and recorder.subscription_by_topic
    linked_nodes.clustering.destroy_publisher(other)
    recorder._discover()
    assert recorder.link_by_topic and not recorder.subscription_by_topic
    linked_nodes.ground.on_points(make_cloud(10**18 + 1))
    recorder.close()
    recorder.destroy_node()
    with Bag(tmp_path / "bag") as bag:
        messages = [message for _, _, message in bag.messages({GROUND_POINTS})]
    assert [m.header.stamp.nanosec for m in messages] == [0, 1] and not published
    assert {f.name for f in messages[0].fields} >= {"ground", "in_view"}


def test_tracker_reads_equal_objects_from_rows_and_cdr():
    rng = np.random.default_rng(0)
    found = Detections.of(rng.normal(0, 5, (20, 7)) ** 2, rng.integers(0, 3, 20), rng.random(20))
    header = make_header(10**18 + 5, "velodyne", make_bag_message)
    for detections in (found, Detections.none()):
        rows = MarkerRows(make_detection_rows(detections, {("Car", 99)}), header)
        sent: list[bytes] = []
        Output(SimpleNamespace(qos_profile=QoSProfile(depth=1), topic_name="/a", publish=sent.append), None).publish(
            rows
        )
        direct, decoded = from_marker_array(rows), from_marker_array(decode(sent[0], MARKERS))
        for name in ("boxes", "scores", "ids"):
            np.testing.assert_array_equal(getattr(direct, name), getattr(decoded, name))
        for name in ("labels", "extras", "notes", "stamp_ns", "frame_id"):
            assert getattr(direct, name) == getattr(decoded, name)


def test_latched_messages_are_always_published():
    sent: list[bytes] = []
    for qos, expected in ((LATCHED, [b"1"]), (RELIABLE, [])):
        sent.clear()
        Output(
            SimpleNamespace(qos_profile=qos, topic_name="/a", publish=sent.append, get_subscription_count=lambda: 0),
            Links(),
        ).publish(b"1")
        assert sent == expected


NODES = ("ground_segmentation", "clustering", "tracker")


def start_together(processes, **params):
    with processes.share_process("graph"):
        for node in NODES:
            processes.start(node, build_graph(["pointnet"], tracking=True)[node], params.get(node, {}))


def test_nodes_of_one_process_have_own_parameters_and_signals(processes, peer):
    start_together(processes, clustering={"input.queu": 5}, tracker={"autostart": False})
    peer.wait(lambda: set(NODES) <= set(peer.diagnostics), "all nodes")
    assert peer.get_message("tracker") == "not configured"
    peer.wait(lambda: peer.get_value("ground_segmentation", f"subscribers of {GROUND_POINTS}") == "1", "the link")
    assert peer.set_parameters("/clustering", {"clustering.dbscan.min_samples": 7}) == []
    processes.running["graph"].send_signal(SIGINT)
    peer.spin_until(lambda: processes.has_ended("graph"), 15.0)
    assert processes.running["graph"].returncode == 0
    log = processes.read_log("graph")
    assert "Traceback" not in log
    (warned,) = [line for line in log.splitlines() if "'input.queu'" in line]
    assert "[clustering]" in warned and "did you mean 'input.queue'" in warned


def test_bad_parameter_of_one_node_ends_the_process_with_code_2(processes):
    start_together(processes, clustering={"clustering.method": "magic"})
    assert processes.running["graph"].wait(timeout=60) == 2
    last = processes.read_log("graph").splitlines()[-1]
    assert "[clustering]" in last and "method = 'magic' must be one of" in last
