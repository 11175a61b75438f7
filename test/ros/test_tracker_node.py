"""The tracker as a real process over DDS, compared with the library on the same detections."""

from __future__ import annotations

import numpy as np
import pytest
from marker_messages import make_detection_markers

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from rclpy.qos import QoSProfile
from robot_bags import read_pose
from ros_samples import MARKERS
from tracking_samples import (
    CAR,
    CYCLIST,
    START,
    TENTH,
    make_car,
    make_crowd_detections,
    make_detections,
    make_flat_pose,
    make_person,
)

from lidar_perception.candidates.configurations import BEST
from lidar_perception.data.bag import Bag
from lidar_perception.nodes.graph import ODOMETRY_INPUT, build_graph
from lidar_perception.nodes.tracker import TrackerNode
from lidar_perception.param_fields import flatten, with_values
from lidar_perception.scoring.tracking.pairs import to_tracked_labels
from lidar_perception.scoring.tracking.report import TrackingReport, make_observation
from lidar_perception.testing.peer import Peer
from lidar_perception.testing.processes import NodesUnderTest
from lidar_perception.tracking.params import TrackingParams
from lidar_perception.tracking.tracker import Tracker
from lidar_perception.types import CLASSES, PEDESTRIAN, Detections
from lidar_perception.wire.codec import decode, encode, make_bag_message
from lidar_perception.wire.messages import make_odometry, to_detections, to_truth
from lidar_perception.wire.topics import CAMERA_INFO, ODOMETRY, POINTS, TRUTH
from msg_utils.detections import to_detection_array
from msg_utils.markers import ADD, from_marker_array
from msg_utils.stamps import make_header, to_ns

NODE, ODOMETRY_TYPE = "tracker", "nav_msgs/msg/Odometry"
REMAP = {"~/input/detections": "/found", "~/output/tracks": "/tracks", "~/input/odometry": "/moved"}
ALL_OF_THEM = QoSProfile(depth=1000)
DELETEALL = 3


def make_cloud_header(stamp, frame_id="lidar"):
    return make_header(stamp, frame_id, make_bag_message)


def read_poses(path):
    """Return the poses of a bag by stamp."""
    with Bag(path) as bag:
        return {to_ns(m.header.stamp): read_pose(m.pose.pose) for _, _, m in bag.messages({ODOMETRY})}


def read_tracks(message):
    """Return stamp, ids, Detections and velocities of an array of tracks."""
    objects = from_marker_array(message)
    return (
        objects.stamp_ns,
        objects.ids.tolist(),
        to_detections(objects),
        [extra["velocity"] for extra in objects.extras],
    )


def assert_same(message, tracks):
    _, ids, found, velocities = read_tracks(message)
    assert ids == tracks.ids.tolist()
    np.testing.assert_array_equal(found.boxes[:, :6], tracks.detections.boxes[:, :6])
    np.testing.assert_allclose(found.boxes[:, 6], tracks.detections.boxes[:, 6], atol=1e-6)
    np.testing.assert_array_equal(found.scores, tracks.detections.scores)
    np.testing.assert_array_equal(found.class_ids, tracks.detections.class_ids)
    np.testing.assert_allclose(np.reshape(velocities, (-1, 2)), tracks.velocities, atol=1e-3)


@pytest.fixture(scope="module")
def looped_messages(domain, drive_bag, tmp_path_factory):
    """Play a drive three times; return {topic: {stamp: its messages in order}} of the graph."""
    params = with_values(BEST, {"seed.source": "automatic"})
    graph = build_graph(["candidates"], single=True, tracking=True)
    outputs = {
        "found": "/perception/output/detections",
        "behind": "/tracker/output/tracks",
        "inside": "/perception/output/tracks",
    }
    with Bag(drive_bag) as bag:
        clouds = bag.counts[POINTS]
    with NodesUnderTest(tmp_path_factory.mktemp("looped"), domain) as processes, Peer(domain) as peer:
        messages = {name: peer.listen(topic, MARKERS, ALL_OF_THEM) for name, topic in outputs.items()}
        for node, remap in graph.items():
            extra = {**flatten(params), "tracking.enabled": True, "input.queue": 2} if node == "perception" else {}
            processes.start(node, {**remap, **ODOMETRY_INPUT}, {**extra, "ego.max_wait": 60.0})
        listeners = {"found": 2, "behind": 1, "inside": 1}  # according to the diagnostics of each node
        peer.wait(
            lambda: all(
                int(peer.get_value(topic.split("/")[1], f"subscribers of {topic}") or 0) >= listeners[name]
                for name, topic in outputs.items()
            ),
            "the nodes to be connected",
        )
        processes.start(
            "bag_player",
            {},
            {
                "bag": str(drive_bag),
                "loop": True,
                "follow": [outputs[name].lstrip("/") for name in ("found", "behind")],
                "wait_for": [
                    POINTS,
                    f"{ODOMETRY}:=2",
                    f"{CAMERA_INFO}:=1",
                    outputs["found"] + ":=3",
                    outputs["behind"] + ":=2",
                ],
                "wait_timeout": 120.0,
            },
        )
        peer.wait(lambda: min(map(len, messages.values())) > 2.5 * clouds, "the drive, three times", 300.0)
        processes.check()
        diagnostics = {key: peer.get_value(NODE, key) for key in ("alive", "born", "ended")}
    return clouds, messages, diagnostics


def assert_tracked(frames, messages, poses, params):
    """Assert that messages equal the library's tracks of `frames`, MarkerArrays of detections. Return the Tracks
    of each frame, None if there was no message.
    """
    tracker, published, messages = Tracker(params), [], iter(messages)
    for frame in map(from_marker_array, frames):
        tracks = tracker(to_detections(frame), frame.stamp_ns, poses.get(frame.stamp_ns))
        published.append(tracks if tracker.frame_used else None)
        if tracker.frame_used and (message := next(messages, None)) is not None:
            assert read_tracks(message)[0] == frame.stamp_ns
            assert message.markers[0].header.frame_id == "velodyne"
            assert_same(message, tracks)
    return published


def test_graph_tracks_equal_library_tracks_and_end_on_loop(looped_messages, drive_bag):
    clouds, messages, diagnostics = looped_messages
    poses = read_poses(drive_bag)
    stamps = [from_marker_array(m).stamp_ns for m in messages["found"]]
    assert len(poses) == clouds and stamps[: 2 * clouds] == 2 * sorted(poses)
    published = assert_tracked(messages["found"], messages["behind"], poses, TrackingParams())
    rounds = [
        {i for t in published[start : start + clouds] if t is not None for i in t.ids.tolist()} for start in (0, clouds)
    ]
    assert rounds[0] and rounds[1] and not rounds[0] & rounds[1]
    assert int(diagnostics["ended"]) > 0 and int(diagnostics["born"]) > 0


def test_ids_follow_the_people_of_the_drive(looped_messages, drive_bag):
    clouds, messages, _ = looped_messages
    with Bag(drive_bag) as bag:
        truth = {o.stamp_ns: to_truth(o) for o in (from_marker_array(m) for _, _, m in bag.messages({TRUTH}))}
    report = TrackingReport()
    for i, message in enumerate(messages["behind"][:clouds]):
        stamp, ids, found, _ = read_tracks(message)
        report.update(make_observation("drive", i, truth[stamp], to_tracked_labels(np.array(ids), found)))
    people = report.compute()["classes"]["Pedestrian"]
    assert people["switches"] == 0 and people["hits"] > clouds


def test_tracker_inside_the_detector_equals_the_library(looped_messages, drive_bag):
    """Each cloud waits for its pose, like the frames of a tracker node."""
    _, messages, _ = looped_messages
    published = assert_tracked(messages["found"], messages["inside"], read_poses(drive_bag), TrackingParams())
    assert any(t is not None and len(t) for t in published)


def test_bad_frames_and_poses_are_reported(processes, peer):
    processes.start(NODE, REMAP, {})
    talker, tracks = peer.advertise("/found", MARKERS), peer.listen("/tracks", MARKERS)
    moving, now = peer.advertise("/moved", ODOMETRY_TYPE), START
    peer.wait(
        lambda: peer.get_message(NODE) and talker.get_subscription_count() and moving.get_subscription_count(),
        "the tracker",
    )

    def send(message, words="tracking", answered=True):
        """Publish once; wait for the expected tracks, if any, and for the reason in the diagnostics."""
        count = len(tracks)
        talker.publish(encode(message))
        peer.wait(lambda: words in peer.get_message(NODE) and len(tracks) >= count + answered, f"'{words}'")
        return tracks[-1]

    def frame(found, frame_id="lidar"):
        nonlocal now
        now += TENTH
        return make_detection_markers(found, make_cloud_header(now, frame_id), make_bag_message)

    def move(poses, child="lidar"):
        """Send poses of the next frames. A second child frame is used once the first one stops."""
        for i, at in enumerate(poses):
            stamp = now + (i + 1) * TENTH
            message = make_odometry(at, make_cloud_header(stamp, "odom"), child, make_bag_message)
            moving.publish(encode(message))
        peer.send(moving, message, lambda: peer.get_value(NODE, "last_pose_ns") == str(stamp), "the poses")

    found = make_detections(make_car(10))
    for _ in range(3):
        assert read_tracks(send(frame(found)))[1] == [1]
    for late, words in (0, "same stamp as the previous one"), (3, "older than the previous one"):
        old = make_detection_markers(found, make_cloud_header(now - late * TENTH), make_bag_message)
        send(old, words, answered=False)
    send(make_bag_message(MARKERS), "an array without markers", answered=False)
    now += TENTH
    gone = make_bag_message("visualization_msgs/msg/Marker", header=make_cloud_header(now), action=DELETEALL)
    assert read_tracks(send(make_bag_message(MARKERS, markers=[gone])))[:2] == (now, [1])  # missed in one frame
    bad = Detections.of([make_car(10), make_car(np.nan), [1, 1, 1, 0, 1, 1, 0]], CAR, [0.9, 0.9, np.nan])
    assert read_tracks(send(frame(bad), "2 of 3 detections are ignored"))[1] == [1]
    many = np.random.default_rng(0).uniform(1, 80, (10_000, 7))
    crowded = send(frame(Detections.of(many, CAR, 0.9)), "the frame has 10000 detections")
    assert len(read_tracks(crowded)[1]) <= 300
    send(frame(found, "other"), "are mixed")
    now += 100 * TENTH
    before = read_tracks(send(frame(found), "are mixed"))[1]
    for i in range(6):  # changing classes stay one track
        last = send(frame(make_detections(make_person(30), kind=[PEDESTRIAN, CYCLIST][i % 2])))
    assert len({*read_tracks(last)[1]} - {*before}) == 1

    assert read_tracks(send(make_detection_markers(found, make_cloud_header(0), make_bag_message), "no stamps"))[0] == 0
    move([make_flat_pose(0.8 * i) for i in range(12)])
    send(frame(found), "first pose arrived")
    for i in range(1, 12):
        last = send(frame(make_detections(make_car(10 - 0.8 * i))))
    assert np.abs(read_tracks(last)[3][0]).max() < 0.3  # the object does not move
    arrows = {m.ns for m in last.markers if m.action == ADD}
    assert arrows == {"Car", "number", "trail"}
    now += 6 * TENTH
    send(frame(make_detections(make_car(10 - 0.8 * 18))), "pose is missing")
    move([make_flat_pose(0.8 * 19)], "base")
    send(frame(make_detections(make_car(10 - 0.8 * 19))), "odometry is for 'base'")
    processes.check()
    assert "Traceback" not in (processes.logs / f"{NODE}.log").read_text()


def test_detection_arrays_are_tracked_like_markers(start_node):
    """The node runs in this process, because vision_msgs may be missing."""
    node, tracker = start_node(TrackerNode), Tracker()
    node.transforms.on_odometry(
        make_odometry(make_flat_pose(50, 0, 1), make_cloud_header(START, "lidar"), "base", make_bag_message)
    )  # detections are in its fixed frame
    for i, found in enumerate(make_crowd_detections()):
        stamp = START + i * TENTH
        node.on_detections(
            to_detection_array(
                found.boxes,
                [CLASSES[kind] for kind in found.class_ids],
                found.scores.tolist(),
                header=make_cloud_header(stamp),
                make=make_bag_message,
            )
        )
        tracks = tracker(found, stamp, np.eye(4))
        published = read_tracks(decode(node.sent["tracks"][-1], MARKERS))
        assert published[1] == tracks.ids.tolist() == [1, 2, 3, 4, 5, 6]
        np.testing.assert_allclose(published[2].boxes, tracks.detections.boxes, atol=1e-4)
