"""Managed nodes, driven over DDS as Nav2's lifecycle manager does: a change of state, then the
state is asked for."""

from __future__ import annotations

import weakref

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.parameter import Parameter
from test_bad_input import CLOUD, MARKERS
from test_pointpillars_node import NODE, REMAP, assert_equal, message, offline, received, values

from lidar_perception.data.bag import Bag
from lidar_perception.detectors.checkpoint import Header, save_checkpoint
from lidar_perception.nodes.ground_segmentation import GroundSegmentation
from lidar_perception.nodes.pointpillars_detector import PointPillarsNode
from lidar_perception.wire.codec import encode
from lidar_perception.wire.topics import POINTS

pytestmark = pytest.mark.usefixtures("one_thread")
LEADS_TO = {"configure": State.PRIMARY_STATE_INACTIVE, "activate": State.PRIMARY_STATE_ACTIVE,
            "deactivate": State.PRIMARY_STATE_INACTIVE, "cleanup": State.PRIMARY_STATE_UNCONFIGURED,
            "unconfigured_shutdown": State.PRIMARY_STATE_FINALIZED}


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    from detection_samples import lively, tiny
    path = tmp_path_factory.mktemp("weights") / "v4.safetensors"
    save_checkpoint(path, lively(tiny("v4")), Header(tiny("v4")))
    return path


@pytest.fixture(scope="module")
def good_cloud(drive_bag):
    with Bag(drive_bag) as bag:
        return next(m for _, _, m in bag.messages({POINTS}))


def state(peer, node):
    return peer.call(f"/{node}/get_state", GetState, GetState.Request()).current_state.id


def change(peer, node, name):
    """Whether the node has done a transition, and is where that leads."""
    number = getattr(Transition, f"TRANSITION_{name.upper()}")
    request = ChangeState.Request(transition=Transition(id=number))
    done = peer.call(f"/{node}/change_state", ChangeState, request).success
    assert not done or state(peer, node) == LEADS_TO[name]
    return done


def drive(peer, node, *names):
    for name in names:
        assert change(peer, node, name), (name, peer.message_of(node))


@pytest.fixture
def here(peer):
    """Nodes in the test's own process, so that it sees what they hold; the middleware between them
    and the peer is the same."""
    made = []

    def make(kind, values, remap):
        rules = [word for a, b in remap.items() for word in ("-r", f"{a}:={b}")]
        node = kind(context=peer.context, cli_args=["--ros-args", *rules], parameter_overrides=[
            Parameter(k, value=list(v) if isinstance(v, tuple) else v) for k, v in values.items()])
        made.append(node)
        node.start()
        peer.executor.add_node(node)
        return node

    yield make
    for node in made:
        peer.executor.remove_node(node)
        node.close()
        node.destroy_node()


def entities(node):
    """How many of each kind a node has."""
    return {kind: len(list(getattr(node, kind))) for kind in (
        "publishers", "subscriptions", "timers", "guards", "services", "clients", "waitables")}


def test_a_manager_takes_a_detector_through_its_states(processes, peer, weights):
    """Nothing is heard or said while it is not active; results are those of the offline detector
    each time it is, on the newest cloud; a shutdown can be asked about afterwards."""
    processes.start(NODE, REMAP, {**values(weights), "autostart": False})
    talker, found = peer.talker("/in", CLOUD), peer.listen("/found", MARKERS)
    assert state(peer, NODE) == State.PRIMARY_STATE_UNCONFIGURED
    peer.wait(lambda: peer.value_of(NODE, "lifecycle") == "unconfigured", "its diagnostics")
    assert ord(peer.diagnostics[NODE].level) == 0 and peer.message_of(NODE) == "not configured"
    drive(peer, NODE, "configure")
    assert talker.get_subscription_count() == 0
    for round_ in (1, 2):
        talker.publish(encode(message(10 * round_)))  # to nobody
        drive(peer, NODE, "activate")
        peer.send(talker, message(10 * round_ + 1), lambda n=round_: received(found, 10 * n + 1),
                  "detections")
        assert_equal(received(found, 10 * round_ + 1), offline(weights, message(1)))
        drive(peer, NODE, "deactivate")
        peer.wait(lambda: not talker.get_subscription_count(), "the end of the subscription")
        peer.wait(lambda: peer.value_of(NODE, "lifecycle") == "inactive"
                  and peer.message_of(NODE) == "not active", "the state in the diagnostics")
        assert received(found, 10 * round_) is None
    drive(peer, NODE, "cleanup", "configure", "activate")
    peer.send(talker, message(31), lambda: received(found, 31), "detections")
    assert not change(peer, NODE, "configure")  # rclpy would end the node
    drive(peer, NODE, "deactivate", "cleanup", "unconfigured_shutdown")
    processes.check()
    assert processes.stop(timeout=15) == {NODE: 0}
    log = (processes.logs / f"{NODE}.log").read_text()
    assert "needs the parameter autostart false" in log and "Traceback" not in log


def test_cleanup_leaves_nothing_of_the_network(here, peer, weights):
    node = here(PointPillarsNode, {**values(weights), "autostart": False}, REMAP)
    talker, found = peer.talker("/in", CLOUD), peer.listen("/found", MARKERS)
    empty, names = entities(node), set(vars(node))
    for stamp in (1, 2):
        drive(peer, NODE, "configure")
        held = [weakref.ref(thing) for thing in (
            node.detector, node.detector.network, node.outputs, node.sensor)]
        drive(peer, NODE, "activate")
        peer.send(talker, message(stamp), lambda n=stamp: received(found, n), "detections")
        assert all(thing() is not None for thing in held)
        drive(peer, NODE, "deactivate")
        assert all(thing() is not None for thing in held)
        drive(peer, NODE, "cleanup")
        assert [thing() for thing in held] == [None] * len(held)
        assert entities(node) == empty and set(vars(node)) == names


def test_a_node_without_its_network_cannot_be_configured(processes, peer, tmp_path, weights):
    """A manager is refused and the reason is an ERROR; once the file is there, it is not."""
    file = tmp_path / "later.safetensors"
    processes.start(NODE, REMAP, {**values(weights), "pointpillars.weights": str(file),
                                  "autostart": False})
    for _ in range(2):
        assert not change(peer, NODE, "configure")
        assert state(peer, NODE) == State.PRIMARY_STATE_UNCONFIGURED
        peer.wait(lambda: f"there is no checkpoint {file}" in peer.message_of(NODE), "the reason")
        assert ord(peer.diagnostics[NODE].level) == 2
    file.write_bytes(weights.read_bytes())
    drive(peer, NODE, "configure", "activate")
    processes.check()


def test_a_node_that_starts_by_itself_takes_a_network_that_comes_later(processes, peer, tmp_path,
                                                                       weights):
    file = tmp_path / "later.safetensors"
    processes.start(NODE, REMAP, {**values(weights), "pointpillars.weights": str(file)})
    talker, found = peer.talker("/in", CLOUD), peer.listen("/found", MARKERS)
    peer.wait(lambda: f"there is no checkpoint {file}" in peer.message_of(NODE), "the reason")
    assert ord(peer.diagnostics[NODE].level) == 2
    (tmp_path / "part").write_bytes(weights.read_bytes())
    (tmp_path / "part").rename(file)
    peer.send(talker, message(1), lambda: received(found, 1), "detections")
    processes.check()


def test_what_waits_is_dropped_and_counted_and_the_pause_is_no_loss(here, peer, good_cloud):
    """sent = frames + dropped + lost holds over a pause, for what is sent while active."""
    node = here(GroundSegmentation, {"input.queue": 3}, {"~/input/points": "/in"})
    talker = peer.talker("/in", CLOUD)
    peer.send(talker, good_cloud, lambda: node.counts["frames"], "a frame")
    name = "ground_segmentation"
    reception, = node._receptions()
    sent = reception.arrivals.sent
    drive(peer, name, "deactivate")
    for _ in range(5):
        talker.publish(encode(good_cloud))
    drive(peer, name, "activate")
    before = node.counts["frames"]
    peer.send(talker, good_cloud, lambda: node.counts["frames"] > before, "a frame")
    arrivals = reception.arrivals
    assert arrivals.lost == 0 and arrivals.sent > sent
    assert node.counts["frames"] + arrivals.dropped + len(reception.waiting) == arrivals.sent
    reception.waiting.extend([b"cloud"] * 2)
    drive(peer, name, "deactivate")
    assert not reception.waiting and reception.arrivals.dropped >= 2


@pytest.mark.parametrize("name", ["perception", "candidate_refinement"])
def test_a_template_that_is_missing_is_known_before_the_first_cloud(processes, peer, name):
    processes.start(name, {}, {"autostart": False, "seed.source": "file",
                               "seed.file": "/nowhere.json"})
    assert not change(peer, name, "configure")
    peer.wait(lambda: "/nowhere.json" in peer.message_of(name), "the reason")
    peer.set_parameter(f"/{name}", "seed.source", "click")
    drive(peer, name, "configure", "activate", "deactivate", "cleanup", "unconfigured_shutdown")
    processes.check()
