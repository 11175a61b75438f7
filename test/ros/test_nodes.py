"""Behaviour that all nodes share: parameters, signals, time, markers."""

from __future__ import annotations

import signal
import subprocess
import sys
from time import sleep

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.parameter import Parameter, parameter_value_to_python

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.nodes import NODES
from lidar_perception.nodes.diagnostics import ERROR, OK, WARN
from lidar_perception.nodes.ground_segmentation import GroundSegmentation
from lidar_perception.nodes.inputs import StampMatcher
from lidar_perception.nodes.interfaces import LATCHED
from lidar_perception.nodes.perception import Perception
from lidar_perception.nodes.rclpy_compat import list_parameter_names
from lidar_perception.param_fields import collect_fields, flatten
from lidar_perception.testing.clouds import make_cloud_message
from lidar_perception.wire.codec import make_bag_message
from msg_utils.markers import from_marker_array

CLOUD, MARKERS = "sensor_msgs/msg/PointCloud2", "visualization_msgs/msg/MarkerArray"
SIGNALS = signal.SIGINT, signal.SIGTERM


def test_every_node_exits_with_0(processes, peer, tmp_path, drive_bag):
    """Send SIGINT and SIGTERM in turn; test_stopping.py sends them in each phase."""
    arguments = {
        "bag_player": {"bag": str(drive_bag), "loop": True, "wait_timeout": 0.0},
        "bag_recorder": {"bag": str(tmp_path / "bag"), "topics": ["/nothing"]},
    }
    for node in NODES:
        processes.start(node, {}, {**arguments.get(node, {}), "input.queu": 5})
    peer.wait(lambda: set(NODES) <= set(peer.diagnostics), "all nodes")
    for i, process in enumerate(processes.running.values()):
        process.send_signal(SIGNALS[i % 2])
    # A node ends within two seconds, or after 6.5 seconds if DDS hangs (stopping.py).
    peer.spin_until(lambda: all(map(processes.has_ended, NODES)), 15.0)
    assert {n: p.returncode for n, p in processes.running.items()} == dict.fromkeys(NODES, 0)
    logs = [*map(processes.read_log, NODES)]
    assert not any("Traceback" in log for log in logs)
    assert all("'input.queu' is ignored; did you mean 'input.queue'" in log for log in logs)


@pytest.fixture(scope="module")
def perception(shared_processes):
    shared_processes.start("perception", {}, {})
    return shared_processes


@pytest.fixture(scope="module")
def talker(shared_peer):
    return shared_peer.advertise("/perception/input/points", CLOUD)


def test_parameters_are_those_of_the_dataclass(perception, shared_peer):
    """Compare names, defaults, descriptions and ranges; a value out of range is rejected with a reason."""
    peer = shared_peer
    names = set(peer.call("/perception/list_parameters", ListParameters, ListParameters.Request()).result.names)
    fields, defaults = collect_fields(PipelineParams()), flatten(PipelineParams())
    assert set(fields) <= names
    request = GetParameters.Request(names=list(fields))
    values = peer.call("/perception/get_parameters", GetParameters, request).values
    for name, value in zip(fields, map(parameter_value_to_python, values), strict=True):
        assert value == (list(d) if isinstance(d := defaults[name], tuple) else d), name
    described = peer.call(
        "/perception/describe_parameters", DescribeParameters, DescribeParameters.Request(names=list(fields))
    ).descriptors
    for d in described:
        assert fields[d.name].metadata["doc"] in d.description
        if fields[d.name].metadata["unit"]:
            assert f"[{fields[d.name].metadata['unit']}]" in d.description

    with peer.override_parameters("/perception", {"stm.threshold": 0.6}):
        for name, value, words in [
            ("stm.threshold", 1.5, ""),
            ("clustering.dbscan.eps", [0.1], "range_limits"),
            ("seed.source", "dream", "ground_truth, click, file"),
        ]:
            (reason,) = peer.set_parameters("/perception", {name: value})
            assert reason and words in reason


@pytest.mark.parametrize("kind", [GroundSegmentation, Perception])
def test_every_parameter_is_readable_and_lists_may_be_empty(start_node, kind):
    """`ros2 param dump` reads all parameters; `ros2 param set` sends [] as a list of booleans."""
    node = start_node(kind)
    declared = list_parameter_names(node)
    values = node.get_parameters(declared)
    assert not [p.name for p in values if p.value is None or p.type_ == Parameter.Type.NOT_SET]
    empty = [p for p in values if p.value == []]
    assert empty
    for p in empty:
        if full := {"crop.sectors": [0, 90], "crop.body": [-1, -1, 0, 1, 1, 2]}.get(p.name):
            assert node.set_parameters([Parameter(p.name, value=full)])[0].successful
            assert list(node.get_parameter(p.name).value) == full
        nothing = Parameter(p.name, Parameter.Type.BOOL_ARRAY, [])
        assert node.set_parameters([nothing])[0].successful
        assert node.get_parameter(p.name).type_ == p.type_
        assert list(node.get_parameter(p.name).value) == []


def test_problem_with_changing_numbers_is_logged_once(start_node, monkeypatch):
    """The end of the problem is logged as well, so the log ends with the current state."""
    node, lines = start_node(GroundSegmentation), []
    monkeypatch.setattr(node.diagnostics, "_log", lambda level, message: lines.append((level, message)))
    for i in range(100):
        node.diagnostics.report(WARN, f"intensity goes up to {i / 7:.2g} where 1 is expected")
        assert node.diagnostics.state[1].startswith(f"intensity goes up to {i / 7:.2g} ")
        if i % 3 == 0:
            node.diagnostics.report(OK, "segmenting")
    node.diagnostics.report(ERROR, "no field 'x'")
    assert [level for level, _ in lines] == [WARN, OK, ERROR]


ARGUMENTS = {
    "-p foo": "-p foo",
    "--params-file /nope.yaml": "/nope.yaml",
    "-r __node:=1bad": "1bad",
    "--nonsense": "--nonsense",
    "-p stm.threshold:=7.0": "stm.threshold",
    "-p bag:=7": "bag",
    f"-p bag:={300 * 'a'}": "File name too long",
}


def test_invalid_ros_arguments_exit_with_code_2(domain):
    """The line has the logger name of the node."""
    program = """
import sys
from time import sleep
from types import SimpleNamespace
from lidar_perception.nodes import main, perception
from lidar_perception.nodes.replay import bag_player
stop = SimpleNamespace(begin_closing=lambda: None, finish_closing=lambda code: None)
for given in sys.argv[1:]:
    kind = bag_player.BagPlayer if "bag" in given else perception.Perception
    arguments = ["x", "--ros-args", "-r", "__node:=front", "-r", "__ns:=/left", *given.split()]
    print(main._run_nodes([(kind, arguments, {})], arguments, 0.0, stop), flush=True)
    print("---", file=sys.stderr, flush=True)
"""
    done = subprocess.run(
        [sys.executable, "-c", program, *ARGUMENTS], text=True, capture_output=True, timeout=100, check=True
    )
    assert done.stdout.split() == ["2"] * len(ARGUMENTS)
    for words, output in zip(ARGUMENTS.values(), done.stderr.split("---\n"), strict=False):
        (fatal,) = [line for line in output.splitlines() if "[FATAL]" in line]
        assert words in fatal and "[left.front]: " in fatal and "Traceback" not in output


def test_unknown_parameter_is_reported(start_node):
    """rclpy itself would report: undeclared parameter(s): []."""
    node = start_node(GroundSegmentation)
    for name, words in (
        ("input.queu", "no parameter 'input.queu'; did you mean 'input.queue'?"),
        ("zzz", "/ground_segmentation has no parameter 'zzz'$"),
    ):
        with pytest.raises(ParameterNotDeclaredException, match=words):
            node.set_parameters_atomically([Parameter(name, value=1)])


def test_bad_parameter_files_are_rejected_in_one_line(processes):
    for i, (name, value, words) in enumerate(
        [("stm.threshold", 7.0, "stm.threshold"), ("clustering.dbscan.eps", [0.1], "range_limits")]
    ):
        processes.start("perception", {}, {name: value}, namespace=f"bad{i}")
        assert processes.running[f"bad{i}.perception"].wait(timeout=60) == 2
        log = processes.read_log(f"bad{i}.perception")
        assert words in log and "Traceback" not in log


def test_missing_template_is_reported_with_first_cloud(perception, shared_peer, talker, good_cloud):
    """It is only a diagnostic, because the file may appear later."""
    peer = shared_peer
    with peer.override_parameters("/perception", {"seed.file": "/nowhere.json"}):
        peer.send(talker, good_cloud, lambda: "/nowhere.json" in peer.get_message("perception"), "the diagnostic")


def test_unused_inputs_change_nothing(perception, shared_peer, talker, good_cloud):
    """The unused inputs are a click while seed.source is `file`, and a CameraInfo without P while the view is
    disabled."""
    peer, found = shared_peer, shared_peer.listen("/perception/output/detections", MARKERS)
    peer.send(talker, good_cloud, lambda: found, "candidates")
    first = from_marker_array(found[-1])
    for topic, kind in (
        ("/clicked_point", "geometry_msgs/msg/PointStamped"),
        ("/perception/input/camera_info", "sensor_msgs/msg/CameraInfo"),
        ("/perception/input/extrinsics", "geometry_msgs/msg/TransformStamped"),
    ):
        other = peer.advertise(topic, kind, LATCHED)
        peer.send(other, make_bag_message(kind), other.get_subscription_count, "a subscriber")
    before = len(found)
    peer.send(talker, good_cloud, lambda: len(found) > before + 2, "more candidates")
    np.testing.assert_array_equal(from_marker_array(found[-1]).boxes, first.boxes)
    assert "Error" not in perception.read_log("perception")


def test_old_markers_are_deleted_and_time_jumps_reported(perception, shared_peer, talker, good_cloud):
    peer, received = shared_peer, shared_peer.listen("/perception/output/boxes", MARKERS)
    peer.send(talker, good_cloud, lambda: received, "boxes")
    full = from_marker_array(received[-1])
    assert len(full) > 20
    assert full.ids.tolist() == [text["id"] for text in full.extras] == [*range(1, 1 + len(full))]
    empty = make_cloud_message(np.zeros((0, 3)), 5 * 10**9, "velodyne")
    peer.send(talker, empty, lambda: len(from_marker_array(received[-1])) == 0, "no boxes")
    deleted = [m for r in received for m in r.markers if m.action == 2]
    assert {m.id for m in deleted} >= set(full.ids.tolist())
    peer.wait(lambda: "time jumped back" in perception.read_log("perception"), "the log line")


def test_clouds_of_a_restarted_bag_are_paired():
    """After the jump in time, no message of the previous round is delivered."""
    for first in ("cloud", "partner"):
        delivered, dropped = [], []
        paired = StampMatcher(lambda c, p, d=delivered: d.append((c, p)), on_drop=dropped.append)
        for round_ in range(3):
            for i in range(30):
                stamp = i * 10**9
                for kind in (first, "partner" if first == "cloud" else "cloud"):
                    (paired.add_cloud if kind == "cloud" else paired.add_partner)(stamp, (round_, i))
        assert delivered == [((r, i), (r, i)) for r in range(3) for i in range(30)]
        paired.add_cloud(30 * 10**9, "waits")
        paired.add_cloud(0, "of the next round")
        paired.clear()
        assert dropped == [1, 1] and len(delivered) == 90


def test_clouds_wait_for_the_message_with_equal_stamp():
    """For any order of arrival, clouds are delivered in order with their partners; a cloud whose partner is lost
    is delivered without one."""
    rng = np.random.default_rng(0)
    delivered = []

    def deliver(cloud, partner):
        delivered.append((cloud, partner))

    for _ in range(50):
        delivered.clear()
        paired = StampMatcher(deliver, capacity=5)
        arrivals = [(i + rng.uniform(0, 2), "cloud", i) for i in range(20)] + [
            (i + rng.uniform(0, 2), "partner", i) for i in range(20)
        ]
        for _, kind, i in sorted(arrivals):
            (paired.add_cloud if kind == "cloud" else paired.add_partner)(i, i)
        assert sorted(c for c, _ in delivered) == list(range(20))
        assert all(p in (None, c) for c, p in delivered)
    delivered.clear()
    for i in range(20):
        paired.add_cloud(100 + i, i)
    assert len(delivered) == 15 and all(p is None for _, p in delivered)


def test_misspelled_section_of_a_parameter_file_is_reported(processes, tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text(
        "trackr: {ros__parameters: {autostart: false}}\n"
        "controller_server: {ros__parameters: {autostart: false}}\n"
        "pointnet_detectr: {ros__parameters: {autostart: false}}\n"
    )
    processes.run_node("tracker", ["tracker", "--ros-args", "--params-file", str(file)])
    process = processes.running["tracker"]
    while "ready" not in (log := processes.read_log("tracker")):
        assert process.poll() is None
        sleep(0.05)
    (warned,) = [line for line in log.splitlines() if "[WARN]" in line and "mine.yaml" in line]
    assert "unknown node 'trackr'" in warned and "did you mean 'tracker'" in warned
