"""A cloud that is cropped to the image waits for its CameraInfo."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from ros_samples import CLOUD, MARKERS, PAPER

from lidar_perception.candidates.pipeline import find_candidates
from lidar_perception.data.bag import Bag
from lidar_perception.data.open import open_recording
from lidar_perception.nodes.graph import CANDIDATES_GRAPH, SINGLE_PROCESS_CANDIDATES
from lidar_perception.nodes.interfaces import LATCHED, SENSOR_DATA
from lidar_perception.param_fields import flatten
from lidar_perception.scoring.centres.report import make_seed_source, select_pedestrians
from lidar_perception.types import Detections
from lidar_perception.wire.codec import encode
from lidar_perception.wire.messages import to_detections
from lidar_perception.wire.topics import CAMERA_INFO, EXTRINSICS, POINTS, TRUTH
from msg_utils.markers import from_marker_array
from msg_utils.stamps import to_ns


def find_offline_candidates(frame):
    people = select_pedestrians(frame.truth())
    if not len(people):
        return Detections.none()
    return find_candidates(frame.load(), make_seed_source(people, None, PAPER), frame.camera(), PAPER)[1].final


@pytest.mark.parametrize(
    "graph, qos",
    [(CANDIDATES_GRAPH, LATCHED), (SINGLE_PROCESS_CANDIDATES, SENSOR_DATA)],
    ids=["three nodes, latched", "one node, a driver's"],
)
def test_cloud_before_its_camera_info_gives_offline_detections(graph, qos, processes, peer, drive_bag):
    frame, expected = next((f, e) for f in open_recording(drive_bag) if len(e := find_offline_candidates(f)))
    with Bag(drive_bag) as bag:
        sent = {
            topic: msg
            for topic, _, msg in bag.messages({POINTS, TRUTH})
            if to_ns((msg.header if topic == POINTS else msg.markers[0].header).stamp) == frame.stamp_ns
        }
        camera = {topic: msg for topic, _, msg in bag.messages({CAMERA_INFO, EXTRINSICS})}
        types = dict(bag.topics)
    first, last = (list(graph)[i] for i in (0, -1))
    for node, remap in graph.items():
        processes.start(node, remap, {**flatten(PAPER), "input.max_wait": 3600.0})
    found = peer.listen(f"/{last}/output/detections", MARKERS)
    truth, cloud = peer.advertise(TRUTH, MARKERS), peer.advertise(POINTS, CLOUD)
    peer.wait_for_graph(graph)
    peer.send(
        cloud,
        sent[POINTS],
        lambda: "waits for the camera's calibration" in peer.get_message(first),
        "the reason why it waits",
    )
    assert not found
    assert len(camera) == 2
    for topic, over in ((CAMERA_INFO, "no CameraInfo on"), (EXTRINSICS, "waits for the camera")):
        assert not found
        talker = peer.advertise(topic, types[topic], qos)
        if qos is LATCHED:
            talker.publish(encode(camera[topic]))
        else:
            assert over in peer.get_message(first)
            peer.send(talker, camera[topic], lambda w=over: w not in peer.get_message(first), f"an end of '{over}'")
    peer.send(truth, sent[TRUTH], lambda: found, "the detections")
    received = to_detections(from_marker_array(found[-1]))
    np.testing.assert_array_equal(received.boxes, expected.boxes)
    np.testing.assert_array_equal(received.scores, expected.scores)
    peer.wait(lambda: peer.get_message(first) in ("detecting", "segmenting"), "a good state")
