"""The bag recorder: latched topics, late publishers, unknown types, and its queue."""

from __future__ import annotations

import os
import sys
import threading

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from rclpy.clock import ClockType

from lidar_perception.data.bag import Bag
from lidar_perception.nodes.interfaces import LATCHED, RELIABLE, SENSOR_DATA
from lidar_perception.wire.codec import encode, make_bag_message

TEXT, INFO = "std_msgs/msg/String", "sensor_msgs/msg/CameraInfo"


def test_recorder_stores_latched_messages_of_every_publisher(processes, peer, tmp_path):
    for i in range(6):  # like nodes with fixed sensors on /tf_static
        peer.advertise("/note", TEXT, LATCHED).publish(encode(make_bag_message(TEXT, data=str(i))))
    processes.start("bag_recorder", {}, {"bag": str(tmp_path / "bag"), "topics": ["/note"]})
    peer.wait(lambda: peer.get_value("bag_recorder", "frames") == "6", "six messages")
    assert processes.stop()["bag_recorder"] == 0
    with Bag(tmp_path / "bag") as bag:
        assert sorted(m.data for _, _, m in bag.messages({"/note"})) == [*"012345"]


def test_late_publisher_with_weaker_qos_is_recorded(processes, peer, tmp_path):
    """The topic may also be in the namespace of the node."""
    first = peer.advertise("/robot/text", TEXT, RELIABLE)
    processes.start("bag_recorder", {}, {"bag": str(tmp_path / "bag"), "topics": ["text"]}, namespace="robot")

    def frames():
        return int(peer.get_value("robot/bag_recorder", "frames") or 0)

    peer.send(first, make_bag_message(TEXT, data="first"), frames, "the first")
    before, later = frames(), peer.advertise("/robot/text", TEXT, SENSOR_DATA)
    peer.send(later, make_bag_message(TEXT, data="later"), lambda: frames() > before, "the later one")
    assert processes.stop()["robot.bag_recorder"] == 0
    with Bag(tmp_path / "bag") as bag:
        assert {m.data for _, _, m in bag.messages({"/robot/text"})} == {"first", "later"}


def test_recording_continues_if_a_type_is_not_installed(monkeypatch, peer, start_node, tmp_path):
    from lidar_perception.nodes.replay import bag_recorder

    known = bag_recorder.load_message_class

    def lacking(name):
        if name == INFO:
            raise ModuleNotFoundError
        return known(name)

    monkeypatch.setattr(bag_recorder, "load_message_class", lacking)
    peer.advertise("/info", INFO)
    peer.advertise("/text", TEXT)
    node = start_node(bag_recorder.BagRecorder, bag=str(tmp_path / "bag"), topics=("/info", "/text"))
    peer.wait(lambda: [node._discover(), not node.waiting_topics][1], "both to be found")
    node.close()
    with Bag(tmp_path / "bag") as bag:
        assert list(bag.topics) == ["/text"]


def test_slow_recorder_drops_and_reports_messages(monkeypatch, start_node, tmp_path):
    """This also holds while simulated time stands still."""
    from lidar_perception.nodes.replay import bag_recorder

    monkeypatch.setattr(bag_recorder, "MAX_QUEUED_BYTES", 100)
    held = threading.Event()
    monkeypatch.setattr(bag_recorder.BagWriter, "write", lambda *_: held.wait())
    stamps = []
    monkeypatch.setattr(
        bag_recorder.BagRecorder,
        "create_subscription",
        lambda self, kind, topic, received, *_, **__: stamps.append(received),
    )
    node = start_node(
        bag_recorder.BagRecorder, **{"bag": str(tmp_path / "bag"), "topics": ["/a"], "use_sim_time": True}
    )
    node.class_by_topic["/a"] = None
    node._subscribe("/a")
    try:
        for _ in range(10):
            stamps[-1](bytes(40))
        assert node.diagnostics.counts["frames"] == 2 and node.diagnostics.counts["dropped"] == 8
        node._discover()
        assert "8 dropped" in node.diagnostics.state[1]
        if sys.platform == "linux":
            writer, others = (os.getpriority(os.PRIO_PROCESS, i) for i in (node.thread.native_id, 0))
            assert writer == min(others + bag_recorder.WRITER_NICENESS, 19)
    finally:
        held.set()
        node.close()
    assert all(timer.clock.clock_type == ClockType.STEADY_TIME for timer in node.timers)
