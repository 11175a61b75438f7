"""The tracker as a real process over DDS, against the library on the same detections."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from test_bad_input import CLOUD, MARKERS
from test_tracker import CAR, PEDESTRIAN, START, TENTH, car, cars, crowd, person, pose

from lidar_perception.candidates.configurations import BEST
from lidar_perception.data.bag import Bag
from lidar_perception.nodes.graph import graph_of
from lidar_perception.nodes.runtime import RELIABLE
from lidar_perception.param_fields import flatten, with_values
from lidar_perception.tracking.params import tracking_of
from lidar_perception.tracking.tracker import Tracker
from lidar_perception.types import CLASSES, Detections
from lidar_perception.wire.codec import bag_message
from lidar_perception.wire.messages import detection_markers, odometry, pose_of, to_detections
from lidar_perception.wire.topics import CAMERA_INFO, ODOMETRY, POINTS, TRUTH
from msg_utils.markers import from_marker_array
from msg_utils.stamps import header_message, to_ns

NODE, ODOMETRY_TYPE = "tracker", "nav_msgs/msg/Odometry"
REMAP = {"~/input/detections": "/found", "~/output/tracks": "/tracks",
         "~/input/odometry": "/moved"}
ALL_OF_THEM = RELIABLE.__class__(depth=1000)


def header(stamp, frame_id="lidar"):
    return header_message(stamp, frame_id, bag_message)


def markers(found, stamp, frame_id="lidar"):
    return detection_markers(found, header(stamp, frame_id), bag_message)


def moved(at, stamp, child="lidar"):
    return odometry(at, header(stamp, "odom"), child, bag_message)


def read(message):
    """stamp, ids, Detections, velocities of an array of tracks."""
    objects = from_marker_array(message)
    return (objects.stamp_ns, objects.ids.tolist(), to_detections(objects),
            [extra["velocity"] for extra in objects.extras])


def assert_same(message, tracks):
    _, ids, found, velocities = read(message)
    assert ids == tracks.ids.tolist()
    np.testing.assert_array_equal(found.boxes[:, :6], tracks.detections.boxes[:, :6])
    np.testing.assert_allclose(found.boxes[:, 6], tracks.detections.boxes[:, 6], atol=1e-6)
    np.testing.assert_array_equal(found.scores, tracks.detections.scores)
    np.testing.assert_array_equal(found.class_ids, tracks.detections.class_ids)
    np.testing.assert_allclose(np.reshape(velocities, (-1, 2)), tracks.velocities, atol=1e-3)


@pytest.fixture(scope="module")
def looped(domain, drive_bag, tmp_path_factory):
    """What the graph says while a drive is played three times: the messages of each topic, those
    of the same stamp in the order in which they came."""
    from ros_peer import Peer

    from lidar_perception.nodes.graph import Processes
    params = with_values(BEST, {"seed.source": "automatic"})
    graph = graph_of(["candidates"], single=True, tracking=True)
    outputs = {"found": "/perception/output/detections", "behind": "/tracker/output/tracks",
               "inside": "/perception/output/tracks"}
    with Bag(drive_bag) as bag:
        clouds = bag.counts[POINTS]
    with Processes(tmp_path_factory.mktemp("looped"), domain) as processes, Peer(domain) as peer:
        heard = {name: peer.listen(topic, MARKERS, ALL_OF_THEM) for name, topic in outputs.items()}
        for node, remap in graph.items():
            extra = ({**flatten(params), "tracking.enabled": True, "input.queue": 2}
                     if node == "perception" else {})
            inside = {"~/input/odometry": "odom"} if node == "perception" else {}
            processes.start(node, {**remap, **inside}, extra)
        processes.start("bag_player", {}, {
            "bag": str(drive_bag), "loop": True, "follow": [outputs["behind"].lstrip("/")],
            "wait_for": [POINTS, f"{ODOMETRY}:=2", f"{CAMERA_INFO}:=1", outputs["found"] + ":=2"],
            "wait_timeout": 120.0})
        peer.wait(lambda: len(heard["behind"]) > 2.5 * clouds, "the drive, three times", 300.0)
        processes.check()
        diagnostics = {key: peer.value_of(NODE, key) for key in ("alive", "born", "ended")}
    return clouds, heard, diagnostics


def test_tracks_of_the_graph_are_those_of_the_library_and_end_with_the_loop(looped, drive_bag):
    clouds, heard, diagnostics = looped
    with Bag(drive_bag) as bag:
        poses = {to_ns(m.header.stamp): pose_of(m.pose.pose)
                 for _, _, m in bag.messages({ODOMETRY})}
    tracker, shown = Tracker(tracking_of("")), []
    frames = [from_marker_array(m) for m in heard["found"]]
    assert len(poses) == clouds and [f.stamp_ns for f in frames[:clouds]] == sorted(poses)
    for frame, message in zip(frames, heard["behind"]):
        tracks = tracker(to_detections(frame), frame.stamp_ns, poses[frame.stamp_ns])
        assert read(message)[0] == frame.stamp_ns
        assert message.markers[0].header.frame_id == "velodyne"
        assert_same(message, tracks)
        shown.append(tracks)
    rounds = [{i for t in shown[start:start + clouds] for i in t.ids.tolist()}
              for start in (0, clouds)]
    assert rounds[0] and rounds[1] and not rounds[0] & rounds[1]
    assert int(diagnostics["ended"]) > 0 and int(diagnostics["born"]) > 0


def test_ids_stay_with_the_people_of_the_drive(looped, drive_bag):
    from lidar_perception.scoring.tracking.report import TrackingReport, observe
    from lidar_perception.scoring.tracking.pairs import tracked_labels
    from lidar_perception.wire.messages import to_truth
    clouds, heard, _ = looped
    with Bag(drive_bag) as bag:
        truth = {o.stamp_ns: to_truth(o) for o in
                 (from_marker_array(m) for _, _, m in bag.messages({TRUTH}))}
    report = TrackingReport()
    for i, message in enumerate(heard["behind"][:clouds]):
        stamp, ids, found, _ = read(message)
        report.update(observe("drive", i, truth[stamp], tracked_labels(np.array(ids), found)))
    people = report.compute()["classes"]["Pedestrian"]
    assert people["switches"] == 0 and people["hits"] > clouds


def test_in_one_process_with_the_detector_tracks_are_the_same(looped):
    _, heard, _ = looped
    own = with_values(Tracker().params, {
        f"existence.neutral.{k}": v
        for k, v in vars(tracking_of("candidates").existence.neutral).items()})
    tracker = Tracker(own)
    compared = 0
    for frame, message in zip(map(from_marker_array, heard["found"]), heard["inside"]):
        assert read(message)[0] == frame.stamp_ns
        compared += len(read(message)[1])
    assert compared
    del tracker


def test_strange_frames_and_poses_end_nothing_and_each_has_its_reason(processes, peer):
    processes.start(NODE, REMAP, {})
    talker, tracks = peer.talker("/found", MARKERS), peer.listen("/tracks", MARKERS)
    moving, now = peer.talker("/moved", ODOMETRY_TYPE, ALL_OF_THEM), START
    peer.wait(lambda: peer.message_of(NODE) and talker.get_subscription_count()
              and moving.get_subscription_count(), "the tracker")

    def frames():
        return int(peer.value_of(NODE, "frames") or 0)

    def send(message, words, answered=True):
        """Publish once; wait until it was worked on, and the diagnostics say so."""
        from lidar_perception.wire.codec import encode
        before, shown = frames(), len(tracks)
        talker.publish(encode(message))
        peer.wait(lambda: words in peer.message_of(NODE) and (
            not answered or len(tracks) > shown) and (
            words.startswith("an array") or frames() > before), f"'{words}'")
        return tracks[-1] if answered else None

    def pose_at(stamp, at, child="lidar"):
        from lidar_perception.wire.codec import encode
        moving.publish(encode(moved(at, stamp, child)))

    def step():
        nonlocal now
        now += TENTH
        return now

    found = cars(car(10))
    for _ in range(3):
        last = send(markers(found, step()), "tracking")
    assert read(last)[1] == [1]
    send(markers(found, now), "has the stamp of the one before", answered=False)
    send(markers(found, now - 3 * TENTH), "older than the last one", answered=False)
    send(bag_message(MARKERS), "an array without a marker", answered=False)
    nothing = bag_message("visualization_msgs/msg/Marker", header=header(step()), action=3)
    empty = send(bag_message(MARKERS, markers=[nothing]), "tracking")
    assert read(empty)[:2] == (now, [1])  # missed, and still there
    bad = Detections.of([car(10), car(np.nan), [1, 1, 1, 0, 1, 1, 0]], CAR, [0.9, 0.9, np.nan])
    assert read(send(markers(bad, step()), "2 of 3 detections are no boxes"))[1] == [1]
    many = np.random.default_rng(0).uniform(-80, 80, (10_000, 7))
    many[:, 3:6] = 1.0
    crowded = send(markers(Detections.of(many, CAR, 0.9), step()), "10000 detections are too many")
    assert len(read(crowded)[1]) <= 300
    assert int(peer.value_of(NODE, "alive")) <= 300
    send(markers(found, step(), "other"), "are mixed")
    now += 100 * TENTH
    last = send(markers(found, step(), "other"), "time jumped")
    first = read(last)[1]
    for i in range(6):  # a class that changes each frame is one track
        kind = [PEDESTRIAN, CLASSES.index("Cyclist")][i % 2]
        last = send(markers(cars(person(30), kind=kind), step(), "other"), "tracking")
    assert len([i for i in read(last)[1] if i not in first]) == 1
    assert {m.ns for m in last.markers if m.action == 0} <= {
        "Car", "Pedestrian", "Cyclist", "number", "velocity", "trail"}

    def reached(stamp):  # poses come on a topic of their own
        return lambda: int(peer.value_of(NODE, "poses") or 0) >= stamp

    pose_at(now + TENTH, pose(0), "other")
    peer.wait(reached(now + TENTH), "a pose")
    send(markers(found, step(), "other"), "poses began")
    for i in range(1, 12):
        pose_at(now + TENTH, pose(0.8 * i), "other")
        peer.wait(reached(now + TENTH), "a pose")
        last = send(markers(cars(car(10 - 0.8 * i)), step(), "other"), "tracking")
    assert np.abs(read(last)[3][0]).max() < 0.3  # what stands, stands
    now += 6 * TENTH
    send(markers(cars(car(10 - 0.8 * 18)), step(), "other"), "pose is missing")
    pose_at(now + TENTH, pose(0.8 * 19), "base")
    peer.wait(reached(now + TENTH), "a pose")
    send(markers(cars(car(10 - 0.8 * 19)), step(), "other"), "odometry is of 'base'")
    pose_at(now + TENTH, np.full((4, 4), np.nan), "other") if False else None
    send(markers(found, 0, "other"), "no stamps")
    processes.check()
    assert "Traceback" not in (processes.logs / f"{NODE}.log").read_text()
    assert CLOUD not in {t for _, ts in peer.node.get_subscriber_names_and_types_by_node(
        NODE, "/") for t in ts}  # clouds are taken for kiss_icp alone
    assert len(list(crowd())) == 20
