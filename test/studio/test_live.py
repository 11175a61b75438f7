"""Frames of a running graph, tested without ROS: storage, late boxes, selection of topics."""

from __future__ import annotations

import sys
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from marker_messages import make_track_markers

from lidar_perception.robot.poses import make_pose, transform_boxes, transform_points
from lidar_perception.types import Detections, InputError
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.topics import TRUTH
from lidar_studio import live_graph
from lidar_studio.live_graph import BOXES, LABELS, TRACKS, LiveGraph
from lidar_studio.live_topics import select_box_topics, select_cloud_topic
from msg_utils.markers import MarkedObjects, from_marker_array
from msg_utils.point_cloud2 import from_array
from msg_utils.stamps import make_header

CLOUD, MARKERS = "sensor_msgs/msg/PointCloud2", "visualization_msgs/msg/MarkerArray"
ARRAY = "vision_msgs/msg/Detection3DArray"
FOUND, TRACKED = "/fused_detector/output/detections", "/tracker/output/tracks"


def cloud(stamp, points=50):
    found = np.zeros(points, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("ground", "u1"), ("cluster_id", "<u4")])
    found["x"] = 1 + np.arange(points)
    found["ground"], found["cluster_id"] = 1, 0
    found["ground"][:10], found["cluster_id"][:10] = 0, 7_000_000
    return from_array(found, make_header(stamp, "velodyne", make_bag_message), make_bag_message)


def boxes(stamp, frame_id="velodyne", x=5.0, ids=(3,)):
    count = len(ids)
    return MarkedObjects(
        np.tile([x, 0, 0, 1, 1, 1, 0], (count, 1)),
        ["Car"] * count,
        np.full(count, 0.5),
        np.array(ids),
        [{"sources": {"pillars": 0.25}}] * count,
        [],
        stamp,
        frame_id,
    )


@pytest.fixture
def live():
    graph = LiveGraph("test", max_frames=5)
    graph.expect_topic(FOUND, BOXES)
    graph.events = []
    graph.listeners.append(graph.events.append)
    return graph


def list_shown_frames(live):
    return [event["live"]["frame"] for event in live.events if "live" in event]


def test_frame_waits_for_its_boxes_and_counts_late_ones(live, monkeypatch):
    live.add_cloud(cloud(10))
    live.add_boxes(FOUND, boxes(10), None)  # the first boxes; from now on clouds wait for this topic
    live.add_cloud(cloud(20))
    assert list_shown_frames(live)[-1] == 0
    live.add_boxes(FOUND, boxes(20), None)
    assert list_shown_frames(live)[-1] == 1
    live.add_cloud(cloud(30))
    monkeypatch.setattr(live_graph, "MAX_WAIT_S", 0.0)
    live.update()
    assert list_shown_frames(live)[-1] == 2 and live.make_layers(2, 0.0)["detections"] == {}
    live.add_boxes(FOUND, boxes(30), None)
    assert list_shown_frames(live)[-2:] == [2, 2]
    (row,) = live.make_layers(2, 0.0)["detections"]["fused_detector"]
    assert row[:9] == [5, 0, 0, 1, 1, 1, 0, "Car", 0.5] and row[9] == {"pillars": 0.25}
    assert [t["late"] for t in live.get_status()["topics"]] == [1]


def test_early_boxes_wait_and_unmatched_boxes_are_counted(live):
    live.add_boxes(FOUND, boxes(10), None)
    live.add_cloud(cloud(10))
    assert len(live.make_layers(0, 0.0)["detections"]["fused_detector"]) == 1
    for stamp in range(1000, 1000 + live_graph.MAX_EARLY_ARRAYS + 3):
        live.add_boxes(FOUND, boxes(stamp), None)
    (topic,) = live.get_status()["topics"]
    assert (topic["unmatched"], topic["late"]) == (3, 0)


@given(st.lists(st.integers(1, 2000), min_size=1, max_size=60), st.integers(1, 12), st.integers(1, 40_000))
def test_live_view_has_bounded_memory_and_keeps_newest_frame(sizes, most, max_bytes):
    live = LiveGraph("test", max_bytes, most)
    for stamp, size in enumerate(sizes):
        live.add_cloud(cloud(stamp, size))
        clouds = [f.cloud for f in live._frames.values()]
        assert live._bytes == sum(len(c.data) for c in clouds)
        assert len(clouds) == 1 or (len(clouds) <= most and live._bytes <= max_bytes)
        assert live.end == stamp + 1 == live.first + len(clouds)
        assert len(live.load_scan(stamp).xyz) == size
        assert len(live._by_stamp) == len(clouds)
    if live.first:
        with pytest.raises(InputError, match="no longer stored"):
            live.load_scan(live.first - 1)


def test_paused_view_keeps_its_frames_and_counts_new_ones(live):
    for stamp in range(4):
        live.add_cloud(cloud(stamp))
    live.set_paused(1, True)
    live.set_paused(2, True)
    live.set_paused(1, False)
    for stamp in range(4, 20):
        live.add_cloud(cloud(stamp))
    assert (live.first, live.end) == (0, 4) and live.get_status()["clouds"]["skipped"] == 16
    live.set_paused(2, False)
    live.add_cloud(cloud(20))
    assert live.end == 5


def test_looping_bag_is_shown_again(live):
    for stamp in (1, 2, 1, 2):
        live.add_cloud(cloud(stamp))
        live.add_boxes(FOUND, boxes(stamp), None)
    assert list_shown_frames(live) == [0, 0, 1, 2, 3]  # that of the first boxes again
    assert all(live.make_layers(i, 0.0)["detections"] for i in range(4))


def test_early_labels_are_matched_when_a_bag_loops(live):
    live.expect_topic("/ground_truth/detections", LABELS)
    for stamp in (1, 2, 1, 2):
        live.add_boxes("/ground_truth/detections", boxes(stamp), None)
        live.add_cloud(cloud(stamp))
    assert all(len(live.make_layers(i, 0.0)["labels"]) == 1 for i in range(4))
    assert live.get_status()["topics"][1]["unmatched"] == 0


def test_missing_tf_is_reported_and_invalid_boxes_left_out(live):
    live.add_cloud(cloud(1))
    live.add_boxes(FOUND, boxes(1, "base_link"), None)
    (line,) = live.get_status()["lines"]
    assert FOUND in line and "TF does not connect 'base_link' with 'velodyne'" in line
    assert live.make_layers(0, 0.0)["detections"] == {}
    wrong = boxes(1, ids=(1, 2, 3, 4))
    wrong.boxes[0, 0], wrong.boxes[1, 4], wrong.scores[2] = np.nan, 0.0, np.inf
    live.add_boxes(FOUND, wrong, None)
    assert len(live.make_layers(0, 0.0)["detections"]["fused_detector"]) == 1
    assert live.get_status()["lines"] == []


def test_boxes_in_another_frame_are_transformed_once_tf_arrives(live, monkeypatch):
    live.expect_topic(TRACKED, TRACKS)
    second = 10**9
    translation, rotation = [1.0, 0.5, 1.7], [0.0, 0.0, np.sin(0.2), np.cos(0.2)]  # by 0.4 rad
    trail = np.array([[5.0, 0.0, 0.0], [6.0, 0.0, 0.0]])
    live.tree.set("base", "velodyne", 0, translation, rotation, static=True)
    live.tree.set("odom", "base", 10 * second, [0, 0, 0], [0, 0, 0, 1])
    live.add_boxes(FOUND, boxes(10 * second), None)
    for i, stamp in enumerate((10 * second, 10 * second + second // 2)):
        live.add_cloud(cloud(stamp))
        pose = make_pose(np.array([4.0 * i / 2, 0, 0]), [0, 0, 0, 1]) @ make_pose(translation, rotation)
        found = Detections.of(transform_boxes(boxes(stamp).boxes, pose), [0], [0.5])
        tracks = make_track_markers(
            np.array([3]),
            found,
            np.zeros((1, 2)),
            np.zeros(1),
            [transform_points(trail, pose)],
            make_header(stamp, "odom", make_bag_message),
            make_bag_message,
        )
        live.add_boxes(TRACKED, from_marker_array(tracks), tracks)
        if i:
            live.add_boxes(FOUND, boxes(stamp), None)
    assert list_shown_frames(live)[-1] == 0  # the other one waits for TF
    assert live.get_status()["lines"] == []
    live.tree.set("odom", "base", 11 * second, [4, 0, 0], [0, 0, 0, 1])
    live.update()
    assert list_shown_frames(live)[-1] == 1
    (track,) = live.list_tracks()
    for row, frame in zip(track["boxes"], (0, 1), strict=True):
        np.testing.assert_allclose(row[1:8], boxes(0).boxes[0], atol=1e-6)
        np.testing.assert_allclose(track["trails"][frame], trail, atol=1e-3)
    monkeypatch.setattr(live_graph, "MAX_WAIT_S", 0.0)
    live.add_cloud(cloud(11 * second + second // 2))
    live.add_boxes(TRACKED, boxes(11 * second + second // 2, "odom"), None)
    assert any("the newest transform" in line for line in live.get_status()["lines"])
    live.add_boxes(FOUND, boxes(11 * second + second // 2), None)
    assert list_shown_frames(live)[-1] == 2  # shown without boxes


def test_two_trackers_have_distinct_ids_and_misses_are_counted(live):
    live.expect_topic(TRACKED, TRACKS)
    live.expect_topic("/b/tracker/output/tracks", TRACKS)
    live.expect_topic("/ground_truth/detections", LABELS)
    live.add_cloud(cloud(1))
    for topic in (TRACKED, "/b/tracker/output/tracks", "/ground_truth/detections"):
        live.add_boxes(topic, boxes(1), None)
    live.add_boxes(FOUND, boxes(1, x=50.0), None)
    assert len({t["id"] for t in live.list_tracks()}) == 2
    match = live.make_layers(0, 0.0)["matches"]["fused_detector"]
    assert match == {"missed": [0], "false": None, "ignored_labels": [], "ignored": None}
    live.forget_topic(TRACKED)  # replaced by another graph
    live.expect_topic("/c/tracker/output/tracks", TRACKS)
    live.add_boxes("/c/tracker/output/tracks", boxes(1), None)
    assert len({t["id"] for t in live.list_tracks()}) == 2


def test_cloud_with_most_columns_and_its_boxes_are_selected():
    one = {
        "/points": CLOUD,
        "/ground_segmentation/output/points": CLOUD,
        "/clustering/output/points": CLOUD,
        FOUND: MARKERS,
        FOUND + "_3d": ARRAY,
        TRACKED: MARKERS,
        "/ground_truth/detections": MARKERS,
        "/clustering/output/boxes": MARKERS,
    }
    assert select_cloud_topic(one) == "/clustering/output/points"
    assert select_box_topics(one, "/clustering/output/points") == {
        FOUND: BOXES,
        TRACKED: TRACKS,
        "/ground_truth/detections": LABELS,
    }
    assert select_box_topics({FOUND + "_3d": ARRAY}, "/points") == {FOUND + "_3d": BOXES}
    assert select_box_topics(one, "/points", requested_topics=["clustering/output/boxes"]) == {
        "/clustering/output/boxes": BOXES,
        TRACKED: TRACKS,
        "/ground_truth/detections": LABELS,
    }
    two = {f"/{ns}{topic}": kind for ns in ("front", "rear") for topic, kind in one.items()}
    with pytest.raises(InputError, match="--namespace"):
        select_cloud_topic(two)
    chosen = select_cloud_topic(two, "rear")
    assert chosen == "/rear/clustering/output/points"
    assert all(topic.startswith("/rear/") for topic in select_box_topics(two, chosen))
    assert select_cloud_topic(two, "front", "points") == "/front/points"
    assert select_cloud_topic({"/velodyne_points": CLOUD, "/x": MARKERS}) == "/velodyne_points"
    for types, requested in (({}, ""), (one, "/no"), ({"/a": CLOUD, "/b": CLOUD}, "")):
        with pytest.raises(InputError) as error_info:
            select_cloud_topic(types, requested_topic=requested)
        assert "\n" not in str(error_info.value)


def test_boxes_of_another_robot_are_not_selected():
    one = dict.fromkeys([FOUND, TRACKED, TRUTH], MARKERS) | {"/clustering/output/points": CLOUD}
    both = one | {f"/b{topic}": kind for topic, kind in one.items()}
    for robot in ("", "/b"):
        clouds, expected = robot + "/clustering/output/points", {robot + FOUND, robot + TRACKED, robot + TRUTH}
        assert select_cloud_topic(both, robot or "/") == clouds
        assert set(select_box_topics(both, clouds, robot or "/")) == expected
        for name in (
            "clustering/output/points",
            "a_clustering/output/points",
            "points",
            "velodyne_points",
            "ouster/points",
        ):
            assert set(select_box_topics(both, f"{robot}/{name}")) == expected
    for clouds, theirs in (
        ("/clustering/output/points", False),
        ("/a/points", False),
        ("/points", True),
        ("/livox/lidar", True),
    ):
        other_boxes = {"/b" + FOUND: MARKERS}  # belongs to another robot, or is the only one
        assert bool(select_box_topics(other_boxes, clouds)) == theirs
        assert not select_box_topics(other_boxes | {"/c" + FOUND: MARKERS}, clouds)
    assert set(select_box_topics(one, "/ouster/points")) == {FOUND, TRACKED, TRUTH}


def test_requests_during_topic_changes_are_thread_safe(live):
    before, wrong = sys.getswitchinterval(), []
    sys.setswitchinterval(1e-6)
    over = threading.Event()

    def ask():
        while not over.is_set():
            try:
                live.get_status(), live.list_frames(), live.list_tracks(), live.first
                live.make_layers(live.end - 1, 0.0)
            except InputError:
                pass  # no longer stored
            except Exception as error:
                wrong.append(error)
                return

    asking = threading.Thread(target=ask)
    asking.start()
    try:
        for i in range(1500):
            topic = f"/{i % 40}/output/detections"
            if i % 3 == 2:
                live.forget_topic(topic)
            else:
                live.expect_topic(topic, BOXES)
            live.add_boxes(topic, boxes(i), None)
            live.add_cloud(cloud(i))
    finally:
        over.set()
        asking.join()
        sys.setswitchinterval(before)
    assert wrong == []
