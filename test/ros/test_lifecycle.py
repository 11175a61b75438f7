"""Managed nodes, driven over DDS like by Nav2's lifecycle manager."""

from __future__ import annotations

import weakref

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from detector_node import POINTPILLARS_NODE as DETECTOR
from detector_node import REMAP, assert_equal, find_received, make_scan_message
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.parameter import Parameter
from ros_samples import CLOUD, MARKERS

from lidar_perception.detectors.checkpoint import Header, save_checkpoint
from lidar_perception.nodes.diagnostics import ERROR, OK, WAITING
from lidar_perception.nodes.ground_segmentation import GroundSegmentation
from lidar_perception.nodes.pointpillars_detector import PointPillarsNode
from lidar_perception.nodes.reception import Reception
from lidar_perception.nodes.tracker import TrackerNode
from lidar_perception.wire.codec import encode
from msg_utils.messages import make_ros_message

NODE, offline = DETECTOR.node, DETECTOR.offline
pytestmark = pytest.mark.usefixtures("one_thread")
LEADS_TO = {
    "configure": State.PRIMARY_STATE_INACTIVE,
    "activate": State.PRIMARY_STATE_ACTIVE,
    "deactivate": State.PRIMARY_STATE_INACTIVE,
    "cleanup": State.PRIMARY_STATE_UNCONFIGURED,
    "unconfigured_shutdown": State.PRIMARY_STATE_FINALIZED,
}


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    from detection_samples import make_random_network, make_tiny_config

    path = tmp_path_factory.mktemp("weights") / "v4.safetensors"
    save_checkpoint(path, make_random_network(make_tiny_config("v4")), Header(make_tiny_config("v4")))
    return path


@pytest.fixture(scope="module")
def peer(shared_peer):
    return shared_peer


@pytest.fixture(scope="module")
def late_weights(tmp_path_factory):
    """Return the path where the test later puts the weights of two nodes."""
    return tmp_path_factory.mktemp("later") / "later.safetensors"


@pytest.fixture(scope="module")
def nodes(shared_processes, weights, late_weights):
    """Start all nodes: with weights, without, without and autostarted, and without a template."""
    values = DETECTOR.values(weights)
    driven = {**values, "autostart": False}
    shared_processes.start(NODE, {}, driven, "ready")
    shared_processes.start(NODE, {}, {**driven, "pointpillars.weights": str(late_weights)}, "waits")
    shared_processes.start(NODE, {}, {**values, "pointpillars.weights": str(late_weights)}, "tries")
    for name in ("perception", "candidate_refinement"):
        shared_processes.start(
            name, {}, {"autostart": False, "seed.source": "file", "seed.file": "/nowhere.json"}, "waits"
        )
    return shared_processes


def get_state(peer, node):
    return peer.call(f"/{node}/get_state", GetState, GetState.Request()).current_state.id


def change_state(peer, node, name):
    """Request a transition; return True if the node is in the resulting state."""
    number = getattr(Transition, f"TRANSITION_{name.upper()}")
    request = ChangeState.Request(transition=Transition(id=number))
    done = peer.call(f"/{node}/change_state", ChangeState, request).success
    assert not done or get_state(peer, node) == LEADS_TO[name]
    return done


def change_states(peer, node, *names):
    for name in names:
        assert change_state(peer, node, name), (name, peer.get_message(node))


@pytest.fixture
def make_local_node(peer):
    """Return a function that creates nodes in this process, so that the test can inspect their memory."""
    nodes = []

    def make(kind, values, remap):
        rules = [word for a, b in remap.items() for word in ("-r", f"{a}:={b}")]
        node = kind(
            context=peer.context,
            cli_args=["--ros-args", *rules],
            parameter_overrides=[Parameter(k, value=list(v) if isinstance(v, tuple) else v) for k, v in values.items()],
        )
        nodes.append(node)
        node.start()
        peer.executor.add_node(node)
        return node

    yield make
    for node in nodes:
        peer.executor.remove_node(node)
        node.close()
        node.destroy_node()


def count_entities(node):
    """Count the publishers, subscriptions and so on of a node."""
    return {
        kind: len(list(getattr(node, kind)))
        for kind in ("publishers", "subscriptions", "timers", "guards", "services", "clients", "waitables")
    }


def test_manager_drives_a_detector_through_all_states(nodes, peer, weights):
    """An inactive node receives and publishes nothing; an active one gives the detections of the
    newest cloud. The state is available after a shutdown."""
    node = f"ready/{NODE}"
    assert get_state(peer, node) == State.PRIMARY_STATE_UNCONFIGURED
    peer.wait(lambda: peer.get_value(node, "lifecycle") == "unconfigured", "its diagnostics")
    assert ord(peer.diagnostics[node].level) == 0 and peer.get_message(node) == "not configured"
    talker = peer.advertise(f"/{node}/input/points", CLOUD)
    found = peer.listen(f"/{node}/output/detections", MARKERS)
    change_states(peer, node, "configure")
    assert talker.get_subscription_count() == 0
    for round_ in (10, 20):
        talker.publish(encode(make_scan_message(round_)))  # nobody receives it
        change_states(peer, node, "activate")
        peer.send(talker, make_scan_message(round_ + 1), lambda n=round_: find_received(found, n + 1), "detections")
        assert_equal(find_received(found, round_ + 1), offline(weights, make_scan_message(1)))
        change_states(peer, node, "deactivate")
        peer.wait(lambda: not talker.get_subscription_count(), "the end of the subscription")
        peer.wait(
            lambda: peer.get_value(node, "lifecycle") == "inactive" and peer.get_message(node) == "not active",
            "the state in the diagnostics",
        )
        assert find_received(found, round_) is None
    change_states(peer, node, "cleanup", "configure", "activate")
    peer.send(talker, make_scan_message(31), lambda: find_received(found, 31), "detections")
    assert not change_state(peer, node, "configure")  # without the package's handler, rclpy would end the node
    change_states(peer, node, "deactivate", "cleanup", "unconfigured_shutdown")
    process = f"ready.{NODE}"
    assert not nodes.has_ended(process) and nodes.end(process) == 0
    assert "is not possible: the node is active\n" in nodes.read_log(process)
    assert "Traceback" not in nodes.read_log(process)


def test_node_without_subscribers_reports_it(make_local_node, peer, monkeypatch):
    """A node that was restarted without its manager is reported, a deactivated one is not."""
    monkeypatch.setattr("lidar_perception.nodes.autostart.MANAGER_TIMEOUT_S", 0.0)
    for kind, topic, sent in ((GroundSegmentation, "points", CLOUD), (TrackerNode, "detections", MARKERS)):
        node = make_local_node(kind, {"autostart": False}, {f"~/input/{topic}": f"/{topic}"})
        name = node.get_name()
        peer.wait(lambda n=name: peer.get_message(n) == "not configured", "its diagnostics")
        talker = peer.advertise(f"/{topic}", sent)
        peer.wait_for_diagnostics(name, f"ros2 lifecycle set /{name} configure", level=1)
        peer.node.destroy_publisher(talker)
        peer.wait(lambda n=name: peer.get_message(n) == "not configured", "the end of the input")
        change_states(peer, name, "configure", "cleanup")
        peer.advertise(f"/{topic}", sent)
        peer.wait(lambda n=node, t=topic: n.count_publishers(f"/{t}"), "the input again")
        node.autostart.check()
        assert node.diagnostics.state == (OK, "not configured")


def test_cleanup_frees_the_network(make_local_node, peer, weights):
    node = make_local_node(PointPillarsNode, {**DETECTOR.values(weights), "autostart": False}, REMAP)
    talker, found = peer.advertise("/in", CLOUD), peer.listen("/found", MARKERS)
    empty, names = count_entities(node), set(vars(node))
    for stamp in (1, 2):
        change_states(peer, NODE, "configure")
        held = [
            weakref.ref(thing) for thing in (node.detector, node.detector.proposer.network, node.results, node.sensor)
        ]
        change_states(peer, NODE, "activate")
        peer.send(talker, make_scan_message(stamp), lambda n=stamp: find_received(found, n), "detections")
        assert all(thing() is not None for thing in held)
        change_states(peer, NODE, "deactivate")
        assert all(thing() is not None for thing in held)
        change_states(peer, NODE, "cleanup")
        assert [thing() for thing in held] == [None] * len(held)
        assert count_entities(node) == empty and set(vars(node)) == names


def test_simulated_clock_works_after_cleanup(make_local_node, peer):
    """use_sim_time may be set before or after the node is configured."""
    name, clock = "ground_segmentation", "rosgraph_msgs/msg/Clock"
    node, talker = make_local_node(GroundSegmentation, {}, {}), peer.advertise("/clock", clock)
    for second, sim_time in enumerate((False, True, True), start=1):
        peer.set_parameter(f"/{name}", "use_sim_time", sim_time)
        change_states(peer, name, "deactivate", "cleanup", "configure", "activate")
        told = make_ros_message(clock, clock=make_ros_message("builtin_interfaces/msg/Time", sec=second))
        assert node.count_subscribers("/clock") == sim_time
        if sim_time:
            peer.send(talker, told, lambda s=second: node.get_clock().now().nanoseconds == s * 10**9, "the time")


def test_node_waits_for_missing_network_file(nodes, peer, late_weights, weights):
    """Configuring fails until the file exists. A node with autostart then loads it automatically."""
    reason = f"checkpoint not found: {late_weights}"
    managed_node, autostarted_node = f"waits/{NODE}", f"tries/{NODE}"
    for _ in range(2):
        assert not change_state(peer, managed_node, "configure")
        assert get_state(peer, managed_node) == State.PRIMARY_STATE_UNCONFIGURED
    for node in (managed_node, autostarted_node):
        peer.wait_for_diagnostics(node, reason, level=2)
        peer.wait(lambda n=node: peer.get_value(n, "lifecycle") == "unconfigured", "the state")
        assert "ready" not in nodes.read_log(node.replace("/", "."))
    part = late_weights.with_name("part")
    part.write_bytes(weights.read_bytes())
    part.rename(late_weights)
    change_states(peer, managed_node, "configure", "activate")
    for node in (managed_node, autostarted_node):
        talker = peer.advertise(f"/{node}/input/points", CLOUD)
        found = peer.listen(f"/{node}/output/detections", MARKERS)
        peer.send(talker, make_scan_message(1), lambda f=found: find_received(f, 1), "detections")
        assert_equal(find_received(found, 1), offline(weights, make_scan_message(1)))
    log = nodes.read_log(f"tries.{NODE}")
    assert log.count(reason) == 1 and log.index(reason) < log.index(": ready")


def test_missing_template_is_reported_at_configure(nodes, peer):
    for name in ("waits/perception", "waits/candidate_refinement"):
        assert not change_state(peer, name, "configure")
        peer.wait_for_diagnostics(name, "/nowhere.json", level=2)
        peer.set_parameter(f"/{name}", "seed.source", "click")
        change_states(peer, name, "configure", "activate", "deactivate", "cleanup", "unconfigured_shutdown")


def test_failed_activation_is_reported_and_retried(make_local_node, peer, monkeypatch):
    def refuse(reception):
        raise RuntimeError("no such policy")

    with monkeypatch.context() as patch:
        patch.setattr(Reception, "open", refuse)
        node = make_local_node(GroundSegmentation, {}, {"~/input/points": "/in"})
        assert (node.get_state_label(), node.diagnostics.state[0]) == ("inactive", ERROR)
        assert "not active: RuntimeError: no such policy" in node.diagnostics.state[1]
    monkeypatch.setattr("lidar_perception.nodes.autostart.MIN_RETRY_PERIOD_S", 0.0)
    node.autostart.retry_at = 0.0
    peer.wait(lambda: node.inputs.is_open and node.get_state_label() == "active", "another attempt")
    assert node.diagnostics.state[1] == WAITING


def test_waiting_clouds_are_dropped_without_counting_pause(make_local_node, peer, good_cloud):
    """For clouds sent while the node is active, sent = frames + dropped + lost."""
    node = make_local_node(GroundSegmentation, {"input.queue": 3}, {"~/input/points": "/in"})
    talker = peer.advertise("/in", CLOUD)
    peer.send(talker, good_cloud, lambda: node.diagnostics.counts["frames"], "a frame")
    name = "ground_segmentation"
    (reception,) = node.inputs.receptions
    sent = reception.arrivals.sent
    change_states(peer, name, "deactivate")
    for _ in range(5):
        talker.publish(encode(good_cloud))
    change_states(peer, name, "activate")
    before = node.diagnostics.counts["frames"]
    peer.send(talker, good_cloud, lambda: node.diagnostics.counts["frames"] > before, "a frame")
    arrivals = reception.arrivals
    assert arrivals.lost == 0 and arrivals.sent > sent
    assert node.diagnostics.counts["frames"] + arrivals.dropped + len(reception.waiting) == arrivals.sent
    reception.waiting.extend([b"cloud"] * 2)
    change_states(peer, name, "deactivate")
    assert not reception.waiting and reception.arrivals.dropped >= 2
