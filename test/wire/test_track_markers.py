"""Tracks as markers: boxes that are read back, and what is drawn beside them."""

from __future__ import annotations

import numpy as np
from samples import each_make, header
from tracking_samples import CAR, START, TENTH, crowd, pose

from lidar_perception.tracking.tracker import Tracker
from lidar_perception.tracking.trails import Trails
from lidar_perception.types import CLASSES, Detections
from lidar_perception.wire.codec import bag_message
from lidar_perception.wire.messages import odometry, pose_of, to_detections
from lidar_perception.wire.track_markers import DRAWN, MAX_ID, NUMBER, VELOCITY, track_markers
from msg_utils.markers import ADD, DELETE, from_marker_array, marker_keys


def arrays(make, frames=20):
    """Tracks and their markers of each frame; every array knows the one before."""
    tracker, trails, shown = Tracker(), Trails(), ()
    for i, found in enumerate(crowd(4, frames)):
        stamp = START + i * TENTH
        tracks = tracker(found if i < 12 else Detections.none(), stamp)
        message = track_markers(
            tracks.ids, tracks.detections, tracks.velocities, tracks.moving,
            trails(tracks, tracker.pose, stamp, 2.0), header(make, stamp), make, previous=shown,
            lifetime_ns=10**9)
        shown = marker_keys(message)
        yield tracks, message


@each_make
def test_tracks_are_read_back_from_the_boxes_and_the_rest_is_drawn_with_their_ids(make):
    for tracks, message in arrays(make):
        objects = from_marker_array(message)
        assert objects.ids.tolist() == tracks.ids.tolist()
        found = to_detections(objects)
        np.testing.assert_array_equal(found.boxes[:, :6], tracks.detections.boxes[:, :6])
        np.testing.assert_array_equal(found.scores, tracks.detections.scores)
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
def test_every_array_deletes_what_the_one_before_showed_and_it_does_not(make):
    before = frozenset()
    for _, message in arrays(make, 60):
        deleted = {(m.ns, m.id) for m in message.markers if m.action == DELETE and m.ns}
        assert deleted == before - marker_keys(message)
        before = marker_keys(message)
    assert not before and message.markers  # nothing is left, and the array says when that was


def test_an_id_beyond_those_of_markers_begins_again():
    found = Detections.of([[1, 2, 3, 4, 5, 6, 0]], CAR, 0.5)
    message = track_markers(np.array([MAX_ID + 7]), found, np.zeros((1, 2)), np.zeros(1),
                            [np.zeros((1, 3))], header(bag_message), bag_message)
    assert {(m.ns, m.id) for m in message.markers} == {(CLASSES[CAR], 7), (NUMBER, 7)}
    assert set(DRAWN).isdisjoint(CLASSES)




@each_make
def test_odometry_holds_a_pose(make):
    at = pose(3.0, -4.0, 2.5)
    message = odometry(at, header(make, frame_id="odom"), "velodyne", make)
    np.testing.assert_allclose(pose_of(message.pose.pose), at, atol=1e-12)
    assert (message.header.frame_id, message.child_frame_id) == ("odom", "velodyne")
