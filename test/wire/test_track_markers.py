"""Tracks as markers."""

from __future__ import annotations

import numpy as np
from marker_messages import make_track_markers
from robot_bags import read_pose
from samples import each_make, make_any_header
from tracking_samples import CAR, START, TENTH, make_crowd_detections, make_flat_pose

from lidar_perception.tracking.tracker import Tracker
from lidar_perception.tracking.trails import Trails
from lidar_perception.types import CLASSES, Detections
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.messages import make_odometry, to_detections
from lidar_perception.wire.track_markers import EXTRA_NAMESPACES, MAX_ID, NUMBER, VELOCITY
from msg_utils.markers import ADD, DELETE, from_marker_array, list_marker_keys


def make_frames(make, frames=20):
    """Yield the tracks and markers of each frame; each array gets the previous one."""
    tracker, trails, previous = Tracker(), Trails(), ()
    for i, frame_detections in enumerate(make_crowd_detections(4, frames)):
        stamp = START + i * TENTH
        tracks = tracker(frame_detections if i < 12 else Detections.none(), stamp)
        message = make_track_markers(
            tracks.ids,
            tracks.detections,
            tracks.velocities,
            tracks.moving,
            trails(tracks, tracker.pose, stamp, 2.0),
            make_any_header(make, stamp),
            make,
            previous=previous,
            lifetime_ns=10**9,
        )
        previous = list_marker_keys(message)
        yield tracks, message


@each_make
def test_tracks_are_read_back_from_their_markers(make):
    for tracks, message in make_frames(make):
        objects = from_marker_array(message)
        assert objects.ids.tolist() == tracks.ids.tolist()
        frame_detections = to_detections(objects)
        np.testing.assert_array_equal(frame_detections.boxes[:, :6], tracks.detections.boxes[:, :6])
        np.testing.assert_array_equal(frame_detections.scores, tracks.detections.scores)
        velocities = np.reshape([e["velocity"] for e in objects.extras], (-1, 2))
        np.testing.assert_allclose(velocities, tracks.velocities, atol=1e-3)
        for m in message.markers:
            assert m.action == DELETE or m.id in tracks.ids
            assert m.header.frame_id == "velodyne" and m.lifetime.sec == 1
        arrows = {m.id: m for m in message.markers if m.ns == VELOCITY and m.action == ADD}
        assert {*arrows} == {*tracks.ids[tracks.moving >= 0.5].tolist()}
        for number, arrow in arrows.items():
            start, end = ([p.x, p.y] for p in arrow.points)
            k = tracks.ids.tolist().index(number)
            np.testing.assert_allclose(np.subtract(end, start), tracks.velocities[k], atol=1e-9)
        texts = [m.text for m in message.markers if m.ns == NUMBER and m.action == ADD]
        assert [t.split()[0] for t in texts] == [str(i) for i in tracks.ids]


@each_make
def test_each_array_deletes_outdated_markers(make):
    before = frozenset()
    for _, message in make_frames(make, 60):
        deleted = {(m.ns, m.id) for m in message.markers if m.action == DELETE and m.ns}
        assert deleted == before - list_marker_keys(message)
        before = list_marker_keys(message)
    assert not before and message.markers  # an array without boxes still has a stamp


def test_large_ids_wrap_around():
    frame_detections = Detections.of([[1, 2, 3, 4, 5, 6, 0]], CAR, 0.5)
    message = make_track_markers(
        np.array([MAX_ID + 7]),
        frame_detections,
        np.zeros((1, 2)),
        np.zeros(1),
        [np.zeros((1, 3))],
        make_any_header(make_bag_message),
        make_bag_message,
    )
    assert {(m.ns, m.id) for m in message.markers} == {(CLASSES[CAR], 7), (NUMBER, 7)}
    assert set(EXTRA_NAMESPACES).isdisjoint(CLASSES)


@each_make
def test_odometry_message_has_the_pose(make):
    at = make_flat_pose(3.0, -4.0, 2.5)
    message = make_odometry(at, make_any_header(make, frame_id="odom"), "velodyne", make)
    np.testing.assert_allclose(read_pose(message.pose.pose), at, atol=1e-12)
    assert (message.header.frame_id, message.child_frame_id) == ("odom", "velodyne")
