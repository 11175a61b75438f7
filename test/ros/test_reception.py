"""Reception of clouds from other drivers: losses are counted, silence is reported."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from rclpy.executors import SingleThreadedExecutor
from ros_samples import CLOUD, MARKERS, make_ros_cloud

from lidar_perception.nodes.arrivals import RATE_INTERVALS
from lidar_perception.nodes.graph import CANDIDATES_GRAPH
from lidar_perception.nodes.ground_segmentation import GroundSegmentation
from lidar_perception.nodes.interfaces import LATCHED
from lidar_perception.nodes.interfaces import RELIABLE as RELIABLE_QOS
from lidar_perception.nodes.reception import BEST_EFFORT, RELIABLE, WINDOW, Arrivals
from lidar_perception.nodes.shared_memory import PROFILE_VARIABLES, SOCKET_BUFFER, read_socket_buffer_size
from lidar_perception.wire.codec import encode
from msg_utils.stamps import to_ns

NODE, OK, WARN, ERROR, STALE = "ground_segmentation", 0, 1, 2, 3
KITTI = 130_000  # points of a cloud: 2 MB
TEXT = "std_msgs/msg/String"


@contextmanager
def start_driver(peer, reliability, count, points=KITTI, first=1, hz=10):
    """Start a process that publishes clouds, without a Fast DDS profile."""
    environment = {k: v for k, v in os.environ.items() if k not in PROFILE_VARIABLES}
    process = subprocess.Popen(
        [
            sys.executable,
            Path(__file__).with_name("driver.py"),
            "/in",
            reliability,
            *map(str, (count, hz, points, first)),
        ],
        env=environment,
        text=True,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    os.set_blocking(process.stdout.fileno(), False)
    try:
        peer.wait(lambda: process.stdout.readline() == "sent\n", "the driver")
        yield
    finally:
        process.communicate("\n", timeout=20)
    assert process.returncode == 0


def test_clouds_are_received_with_any_reliability(processes, peer):
    """A RELIABLE driver loses nothing. A BEST_EFFORT driver loses little if the socket buffer holds a cloud, and
    losses are reported with a remedy. When it ends, the diagnostic is ERROR, then STALE."""

    def value(key):
        return int(peer.get_value(NODE, key) or 0)

    def level():
        return ord(peer.diagnostics[NODE].level)

    def done():
        return value("frames") + value("dropped")

    for name in PROFILE_VARIABLES:  # the node chooses its profile, as if a user had started it
        processes.environment.pop(name, None)
    processes.start(
        NODE, {"~/input/points": "/in"}, {"input.error_after": 1, "input.stale_after": 3, "input.max_lost": 0}
    )
    with start_driver(peer, "reliable", 30):
        peer.wait(lambda: done() == 30, "all clouds of a reliable driver")
    assert value("lost") == 0 and peer.get_value(NODE, "reliability") == "reliable"
    assert peer.diagnostics[NODE].hardware_id == "driver_lidar"
    peer.wait(lambda: level() == ERROR and "no cloud on /in for more than 1 s" in peer.get_message(NODE), "the silence")
    peer.wait(lambda: level() == STALE and "more than 3 s" in peer.get_message(NODE), "it is stale")

    before = value("frames")
    with start_driver(peer, "best_effort", 30, first=100):
        peer.wait(lambda: value("last_stamp_ns") >= 120 * 10**9 or value("lost"), "clouds")
        assert peer.get_value(NODE, "reliability") == "best effort"
    peer.wait(lambda: "no cloud" in peer.get_message(NODE), "the end")
    assert value("frames") > before and done() + value("lost") <= 60
    if read_socket_buffer_size() >= SOCKET_BUFFER:
        assert done() - 30 > 15  # a plain rclpy subscriber receives a third
    if value("lost"):
        log = (processes.logs / f"{NODE}.log").read_text()
        assert log.count("were lost in transit; make /driver publish reliable") == 1
    peer.set_parameter(f"/{NODE}", "input.error_after", 1000)
    peer.set_parameter(f"/{NODE}", "input.stale_after", 1000)
    peer.wait(lambda: "no cloud" not in peer.get_message(NODE), "no limit")

    with start_driver(peer, "reliable", 30, points=2000, first=200):  # some are lost while the node reconnects
        peer.wait(lambda: value("last_stamp_ns") == 229 * 10**9, "a reliable one again")
        assert peer.get_value(NODE, "reliability") == "reliable"
    processes.check()


def test_newest_cloud_is_processed_and_dropped_ones_counted(processes, peer):
    """A burst arrives while a node processes a large cloud. A second publisher is reported."""
    processes.start(NODE, {"~/input/points": "/in"}, {"ground.method": "patchwork"})
    talker, rng = peer.advertise("/in", CLOUD), np.random.default_rng(0)
    large, *small = (
        encode(make_ros_cloud(rng.uniform(-50, 50, (n, 3)) * [1, 1, 0.05], stamp))
        for stamp, n in enumerate([1_000_000, *[2000] * 40], start=2)
    )
    peer.wait(talker.get_subscription_count, "the node")
    talker.publish(encode(make_ros_cloud(np.ones((9, 3)), 1)))
    peer.wait(lambda: peer.get_value(NODE, "frames") == "1", "the first cloud")
    for data in (large, *small):
        talker.publish(data)
    peer.wait(lambda: peer.get_value(NODE, "last_stamp_ns") == "42", "the newest")

    def accounted():
        return [int(peer.get_value(NODE, key)) for key in ("frames", "dropped", "lost")]

    peer.wait(lambda: sum(accounted()) == 42, "an account of every cloud")
    assert accounted()[0] < 30
    other = peer.advertise("/in", CLOUD)
    peer.wait(lambda: "2 publishers on /in (/peer, /peer)" in peer.get_message(NODE), "a warning")
    peer.node.destroy_publisher(other)
    peer.wait(lambda: "publishers" not in peer.get_message(NODE), "no warning")


SIDES = "left", "right"


@pytest.fixture(scope="module")
def two_sensors(shared_processes):
    for side in SIDES:
        shared_processes.start_graph(["candidates"], {"seed.source": "click"}, namespace=side)
    return shared_processes


def test_sensors_in_two_namespaces_are_separate(two_sensors, shared_peer):
    """Two equal graphs share no topic, and the diagnostics name the sensor."""
    peer = shared_peer
    talkers = {side: peer.advertise(f"/{side}/points", CLOUD) for side in SIDES}
    found = {side: peer.listen(f"/{side}/candidate_refinement/output/detections", MARKERS) for side in SIDES}
    click = peer.advertise("/right/clicked_point", "geometry_msgs/msg/PointStamped")
    peer.wait(click.get_subscription_count, "the clicked points of one")
    street = np.random.default_rng(0).uniform(-20, 20, (5000, 3)) * [1, 1, 1e-3] - [0, 0, 1.73]
    for i, (side, talker) in enumerate(talkers.items()):
        stamp = 5 * 10**9 * (i + 1)
        peer.send(talker, make_ros_cloud(street, stamp), lambda s=side: found[s], f"the result of {side}")
        assert {to_ns(m.markers[0].header.stamp) for m in found[side]} == {stamp}
        assert found[side][0].markers[0].lifetime.sec == 2  # so that boxes of a dead node disappear
    own = {f"{side}/{node}": (side, f"{side}/lidar") for side in SIDES for node in CANDIDATES_GRAPH}
    peer.wait(lambda: own.keys() <= peer.diagnostics.keys(), "diagnostics of all")
    assert all(peer.diagnostics[name].hardware_id in ids for name, ids in own.items())
    peer.wait(
        lambda: all(peer.diagnostics[f"{side}/clustering"].hardware_id == f"{side}/lidar" for side in SIDES),
        "the sensors' frames",
    )
    names = {name for name, _ in peer.node.get_topic_names_and_types()}
    ours = {t for t in names if not t.startswith(("/left/", "/right/"))}
    assert ours <= {"/diagnostics", "/parameter_events", "/rosout", "/tf_static", "/clock"}
    two_sensors.check()


def test_two_nodes_with_the_same_name_are_reported(two_sensors, shared_peer, processes):
    processes.start("clustering", {}, {}, namespace="left")
    shared_peer.wait_for_diagnostics("left/clustering", "another node is also called /left/clustering", WARN)


def make_infos(numbers, period=10**8):
    return [{"publication_sequence_number": n, "source_timestamp": n * period} for n in numbers]


def test_every_cloud_is_processed_or_counted_as_dropped():
    """sent = received + dropped + lost, for any combination of losses and full queues."""
    rng = np.random.default_rng(0)
    for _ in range(100):
        arrivals, taken, number, sizes = Arrivals(5), 0, 0, []
        while number < 300:
            steps = rng.choice([1, 1, 1, 2, 9], rng.integers(1, 7))
            numbers = number + np.cumsum(steps)
            number = int(numbers[-1])
            arrivals.add(make_infos(numbers.tolist()), len(numbers) - 1)
            taken += 1
            sizes.append(steps[0] - 1)
        first = sizes[0]  # the number before the first is unknown
        assert arrivals.sent == number - first == taken + arrivals.dropped + arrivals.lost
        sent_count, lost_count, dropped_count = arrivals.count_recent()
        assert 0 <= lost_count + dropped_count < sent_count and sent_count >= WINDOW
        assert arrivals.expected_rate == arrivals.measure_rate() == pytest.approx(10)


def test_cloud_dropped_from_full_queue_is_not_counted_lost():
    arrivals = Arrivals(5)
    arrivals.add(make_infos([1]), 0)
    arrivals.add(make_infos([8, 9, 10, 11, 12]), 4)
    assert (arrivals.lost, arrivals.dropped, arrivals.sent) == (0, 10, 12)
    arrivals.add(make_infos([15, 16]), 1)
    assert (arrivals.lost, arrivals.dropped, arrivals.sent) == (2, 11, 16)


def test_restarted_or_second_driver_loses_no_cloud():
    arrivals = Arrivals(5)
    for number in (7, 8, 1, 2):
        arrivals.add(make_infos([number]), 0)
    arrivals.add(make_infos([90]), 0, has_one_publisher=False)
    arrivals.add(make_infos([99]), 0)  # the first publisher again, alone
    arrivals.add(make_infos([101]), 0)
    assert (arrivals.lost, arrivals.dropped, arrivals.sent) == (1, 0, 8)


def test_lower_rate_of_a_sensor_is_measured_from_its_stamps():
    arrivals = Arrivals(5)
    for number in range(1, 30):
        arrivals.add(make_infos([number]), 0)
    for info in make_infos(range(30, 30 + RATE_INTERVALS)):
        info["source_timestamp"] = 29 * 10**8 + (info["publication_sequence_number"] - 29) * 10**9
        arrivals.add([info], 0)
    assert arrivals.expected_rate == pytest.approx(10) and arrivals.measure_rate() == pytest.approx(1)


OVERRIDE = f"qos_overrides./{NODE}/input/points.subscription.reliability"


@pytest.mark.parametrize(
    "values, remedy",
    [
        ({}, ""),
        ({OVERRIDE: "best_effort"}, ""),
        ({OVERRIDE: "reliable"}, OVERRIDE),
        ({"input.reliability": "reliable"}, "input.reliability to auto"),
    ],
)
def test_incompatible_publisher_is_reported_with_remedy(start_node, monkeypatch, values, remedy):
    (reception,) = start_node(GroundSegmentation, **values).inputs.receptions
    for offered in ({RELIABLE}, {BEST_EFFORT}, {RELIABLE, BEST_EFFORT}):
        there = [
            SimpleNamespace(
                node_namespace="/", node_name=kind.name.lower(), qos_profile=SimpleNamespace(reliability=kind)
            )
            for kind in offered
        ]
        monkeypatch.setattr(reception, "list_publishers", lambda there=there: there)
        reception.adapt()
        requested = reception.subscription.qos_profile.reliability
        texts = [text for kind, _, text in reception.problems() if kind == "incompatible"]
        assert bool(texts) == (requested == RELIABLE and BEST_EFFORT in offered)
        assert all(text.startswith("/best_effort on /") and remedy in text for text in texts)
        assert bool(texts) == (remedy != "" and BEST_EFFORT in offered)


def test_middleware_queue_has_the_length_of_the_input_queue(start_node):
    for queue, depth in (1, 5), (20, 20):
        (reception,) = start_node(GroundSegmentation, **{"input.queue": queue}).inputs.receptions
        assert reception.subscription.qos_profile.depth == reception.arrivals.depth == depth


def test_publisher_without_latching_is_reported_with_remedy(peer, start_node):
    node = start_node(GroundSegmentation)
    node.inputs.subscribe("/static", TEXT, lambda _: None, LATCHED, private=False)
    peer.advertise("/static", TEXT, RELIABLE_QOS)
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    peer.wait(lambda: [executor.spin_once(0.0), "transient local" in node.diagnostics.state[1]][1], "the remedy")


def test_lost_clouds_are_attributed_to_an_ended_driver(start_node, monkeypatch):
    (reception,) = start_node(GroundSegmentation, **{"input.max_lost": 0}).inputs.receptions
    driver = SimpleNamespace(
        node_namespace="/", node_name="driver", qos_profile=SimpleNamespace(reliability=BEST_EFFORT)
    )
    for there in ([driver], []):
        monkeypatch.setattr(reception, "list_publishers", lambda there=there: there)
        reception.adapt()
        reception.arrivals.add(
            [{"publication_sequence_number": number, "source_timestamp": number} for number in (1, 3)], 0
        )
        (message,) = (text for kind, _, text in reception.problems() if kind == "lost")
        assert "make /driver publish reliable" in message
