"""What all nodes have in common: parameters, signals, time, markers."""

from __future__ import annotations

import signal

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.data.bag import Bag
from lidar_perception.nodes import NODES
from lidar_perception.nodes.inputs import Paired
from lidar_perception.nodes.runtime import LATCHED
from lidar_perception.param_fields import flatten, parameter_fields
from lidar_perception.wire.codec import bag_message
from lidar_perception.wire.topics import POINTS
from msg_utils.markers import from_marker_array
from msg_utils.stamps import time_message

CLOUD, MARKERS = "sensor_msgs/msg/PointCloud2", "visualization_msgs/msg/MarkerArray"


@pytest.fixture
def arguments(tmp_path, drive_bag):
    """What a node needs to start."""
    return {"bag_player": {"bag": str(drive_bag), "loop": True, "wait_timeout": 0.0},
            "bag_recorder": {"bag": str(tmp_path / "bag"), "topics": ["/nothing"]}}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_every_node_ends_with_code_0(processes, peer, arguments, number):
    for node in NODES:
        processes.start(node, {}, arguments.get(node, {}))
    peer.wait(lambda: set(NODES) <= set(peer.diagnostics), "all nodes")
    for process in processes.running.values():
        process.send_signal(number)
    # Two seconds for each as a rule; where DDS hangs, stopping.py ends a node after 6.5.
    peer.until(lambda: all(map(processes.ended, NODES)), 15.0)
    assert {n: p.returncode for n, p in processes.running.items()} == dict.fromkeys(NODES, 0)
    for node in NODES:
        assert "Traceback" not in (processes.logs / f"{node}.log").read_text()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_during_the_start_ends_with_code_0_too(processes, number):
    from time import sleep
    processes.start("perception", {}, {})
    sleep(0.7)  # the moment does not matter: whichever phase it hits must end well
    processes.running["perception"].send_signal(number)
    assert processes.running["perception"].wait(timeout=10) == 0


def test_parameters_are_those_of_the_dataclass(processes, peer):
    """Names, defaults, descriptions and ranges; a value out of range is refused with a reason."""
    processes.start("perception", {}, {})
    names = set(peer.call("/perception/list_parameters", ListParameters,
                          ListParameters.Request()).result.names)
    fields, defaults = parameter_fields(PipelineParams()), flatten(PipelineParams())
    assert set(fields) <= names
    request = GetParameters.Request(names=list(fields))
    values = peer.call("/perception/get_parameters", GetParameters, request).values
    for name, value in zip(fields, values):
        stored = {1: value.bool_value, 2: value.integer_value, 3: value.double_value,
                  4: value.string_value, 8: tuple(value.double_array_value)}[value.type]
        assert stored == defaults[name], name
    described = peer.call("/perception/describe_parameters", DescribeParameters,
                          DescribeParameters.Request(names=list(fields))).descriptors
    for d in described:
        assert fields[d.name].metadata["doc"] in d.description
        if fields[d.name].metadata["unit"]:
            assert f"[{fields[d.name].metadata['unit']}]" in d.description

    def change(name, **value):
        request = SetParameters.Request(parameters=[
            Parameter(name=name, value=ParameterValue(**value))])
        return peer.call("/perception/set_parameters", SetParameters, request).results[0]

    double = ParameterType.PARAMETER_DOUBLE
    assert change("stm.threshold", type=double, double_value=0.6).successful
    refused = change("stm.threshold", type=double, double_value=1.5)
    assert not refused.successful and refused.reason
    refused = change("clustering.dbscan.eps", type=ParameterType.PARAMETER_DOUBLE_ARRAY,
                     double_array_value=[0.1])
    assert not refused.successful and "range_limits" in refused.reason
    refused = change("seed.source", type=ParameterType.PARAMETER_STRING, string_value="dream")
    assert not refused.successful and "ground_truth, click, file" in refused.reason


@pytest.mark.parametrize("values, words", [
    ({"stm.threshold": 7.0}, "stm.threshold"),
    ({"clustering.dbscan.eps": [0.1]}, "range_limits"),
    ({"seed.file": "/nowhere.json"}, None),
])
def test_bad_parameter_files_are_refused_in_one_line(processes, peer, values, words, drive_bag):
    processes.start("perception", {"~/input/points": "/in"}, values)
    if words is None:  # found out with the first cloud: a diagnostic, as the file may appear
        with Bag(drive_bag) as bag:
            msg = next(m for _, _, m in bag.messages({POINTS}))
        peer.send(peer.talker("/in", CLOUD), msg,
                  lambda: "/nowhere.json" in peer.message_of("perception"), "the diagnostic")
        return
    peer.wait(lambda: processes.ended("perception"), "the end")
    assert processes.running["perception"].returncode == 2
    log = (processes.logs / "perception.log").read_text()
    assert words in log and "Traceback" not in log


def test_markers_that_go_away_are_deleted_and_time_that_jumps_back_is_noticed(
        processes, peer, drive_bag):
    with Bag(drive_bag) as bag:
        msg = next(m for _, _, m in bag.messages({POINTS}))
    processes.start("perception", {"~/input/points": "/in", "~/output/boxes": "/boxes"}, {})
    talker, received = peer.talker("/in", CLOUD), peer.listen("/boxes", MARKERS)
    peer.send(talker, msg, lambda: received, "boxes")
    full = from_marker_array(received[-1])
    assert len(full) > 20
    assert full.ids.tolist() == [text["id"] for text in full.extras] == [*range(1, 1 + len(full))]
    near = bag_message(CLOUD, **{f: getattr(msg, f) for f in (
        "fields", "point_step", "is_bigendian", "data", "is_dense")}, height=1, width=0)
    near.header = bag_message("std_msgs/msg/Header", frame_id="velodyne",
                              stamp=time_message(5 * 10**9, bag_message))
    peer.send(talker, near, lambda: len(from_marker_array(received[-1])) == 0, "no boxes")
    deleted = [m for r in received for m in r.markers if m.action == 2]
    assert {m.id for m in deleted} >= set(full.ids.tolist())
    peer.wait(lambda: "time went back" in (processes.logs / "perception.log").read_text(),
              "the log line")


def test_inputs_that_are_not_asked_for_change_nothing(processes, peer, drive_bag):
    """A click while the seed is a file, and a CameraInfo without P while the crop is off."""
    with Bag(drive_bag) as bag:
        msg = next(m for _, _, m in bag.messages({POINTS}))
    processes.start("perception", {"~/input/points": "/in", "~/output/detections": "/found",
                                   "~/input/camera_info": "/info", "~/input/extrinsics": "/pose"},
                    {"seed.source": "file"})
    found, talker = peer.listen("/found", MARKERS), peer.talker("/in", CLOUD)
    peer.send(talker, msg, lambda: found, "candidates")
    first = from_marker_array(found[-1])
    for topic, kind in (("/clicked_point", "geometry_msgs/msg/PointStamped"),
                        ("/info", "sensor_msgs/msg/CameraInfo"),
                        ("/pose", "geometry_msgs/msg/TransformStamped")):
        other = peer.talker(topic, kind, LATCHED)
        peer.send(other, bag_message(kind), other.get_subscription_count, "a subscriber")
    before = len(found)
    peer.send(talker, msg, lambda: len(found) > before + 2, "more candidates")
    np.testing.assert_array_equal(from_marker_array(found[-1]).boxes, first.boxes)
    assert "Error" not in (processes.logs / "perception.log").read_text()


def test_a_bag_that_starts_again_pairs_its_clouds_with_the_new_round():
    """Whichever comes first after the jump, nothing of the round before is given out."""
    for first in ("cloud", "partner"):
        delivered = []
        paired = Paired(lambda c, p, d=delivered: d.append((c, p)))
        for round_ in range(3):
            for i in range(30):
                stamp = i * 10**9
                for kind in (first, "partner" if first == "cloud" else "cloud"):
                    (paired.add_cloud if kind == "cloud" else paired.add_partner)(
                        stamp, (round_, i))
        assert delivered == [((r, i), (r, i)) for r in range(3) for i in range(30)]


def test_clouds_wait_for_the_partner_with_their_stamp():
    """Whatever the order of arrival, each cloud gets its own partner, in the order of the clouds;
    one whose partner is lost gets none, and is not waited for for ever."""
    rng = np.random.default_rng(0)
    delivered = []

    def deliver(cloud, partner):
        delivered.append((cloud, partner))

    for _ in range(50):
        delivered.clear()
        paired = Paired(deliver, capacity=5)
        arrivals = ([(i + rng.uniform(0, 2), "cloud", i) for i in range(20)]
                    + [(i + rng.uniform(0, 2), "partner", i) for i in range(20)])
        for _, kind, i in sorted(arrivals):
            (paired.add_cloud if kind == "cloud" else paired.add_partner)(i, i)
        assert sorted(c for c, _ in delivered) == list(range(20))
        assert all(p in (None, c) for c, p in delivered)
    delivered.clear()
    for i in range(20):
        paired.add_cloud(100 + i, i)
    assert len(delivered) == 15 and all(p is None for _, p in delivered)
