"""CDR of arrays, compared with the serialization of message objects by rclpy and rosbags."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import make_any_header
from tracking_samples import START, TENTH, make_crowd_detections

from lidar_perception.tracking.tracker import Tracker
from lidar_perception.tracking.trails import Trails
from lidar_perception.types import CLASSES, Detections
from lidar_perception.wire.array_codec import encode_detection_array, encode_markers
from lidar_perception.wire.codec import decode, encode, make_bag_message
from lidar_perception.wire.messages import make_detection_rows
from lidar_perception.wire.track_markers import make_track_rows
from msg_utils.detections import to_detection_array
from msg_utils.markers import MarkerRow, list_marker_keys, make_marker_rows, rows_to_message
from msg_utils.messages import make_ros_message

ARRAY = "visualization_msgs/msg/MarkerArray"

numbers = st.floats(-1e6, 1e6) | st.sampled_from([-0.0, float("inf"), float("nan")])
triples = st.tuples(numbers, numbers, numbers)
pairs = st.tuples(numbers, numbers)
float32s = st.floats(0, 1, width=32)
texts = st.text(st.characters(exclude_categories=("Cs", "Cc")), max_size=9)
int32s = st.integers(-(2**31), 2**31 - 1)
rows = st.lists(
    st.builds(
        MarkerRow,
        ns=texts,
        id=int32s,
        action=int32s,
        type=int32s,
        text=texts,
        position=triples,
        quaternion=pairs,
        scale=triples,
        color=st.tuples(*4 * [float32s]),
        points=st.none() | st.lists(triples, max_size=3).map(lambda p: np.reshape(p, (-1, 3))),
    ),
    max_size=4,
)


def assert_equal_cdr(got: bytes, rows, stamp_ns=START, frame_id="velodyne", lifetime_ns=0):
    """Compare with both serializations; rclpy leaves the bytes of padding undefined."""
    ours, theirs = (
        rows_to_message(rows, make_any_header(make, stamp_ns, frame_id), make, lifetime_ns)
        for make in (make_bag_message, make_ros_message)
    )
    assert got == encode(ours)
    serialization = pytest.importorskip("rclpy.serialization", reason="needs rclpy")
    raw = serialization.serialize_message(theirs)
    assert len(raw) == len(got) and encode(decode(raw, ARRAY)) == got


@given(rows=rows, stamp_ns=st.integers(0, 2**60), frame_id=texts, lifetime_ns=st.integers(0, 2**60))
def test_encoded_markers_equal_the_serialized_message(rows, stamp_ns, frame_id, lifetime_ns):
    head = make_any_header(make_bag_message, stamp_ns, frame_id)
    assert_equal_cdr(encode_markers(rows, head, lifetime_ns), rows, stamp_ns, frame_id, lifetime_ns)


def test_encoded_tracks_equal_the_serialized_message():
    tracker, trails, previous = Tracker(), Trails(), ()
    for i, frame_detections in enumerate(make_crowd_detections(4, 15)):
        stamp = START + i * TENTH
        tracks = tracker(frame_detections if i < 12 else Detections.none(), stamp)
        track_rows = make_track_rows(
            tracks.ids,
            tracks.detections,
            tracks.velocities,
            tracks.moving,
            trails(tracks, tracker.pose, stamp, 2.0),
            previous=previous,
        )
        previous = list_marker_keys(track_rows)
        for rows in (track_rows, make_detection_rows(frame_detections)):
            assert_equal_cdr(encode_markers(rows, make_any_header(make_bag_message, stamp)), rows, stamp)
    assert previous


def test_encoded_empty_array_equals_the_serialized_message():
    rows = make_marker_rows(np.zeros((0, 7)), [])
    assert_equal_cdr(encode_markers(rows, make_any_header(make_bag_message, START)), rows)


@given(boxes=st.lists(st.tuples(*6 * [numbers], st.floats(-4, 4)), max_size=3), frame_id=texts, seed=st.integers(0, 9))
def test_encoded_detection_array_equals_the_serialized_message(boxes, frame_id, seed):
    """vision_msgs is not in the wheels of ROS, so the reference is rosbags alone."""
    rng, count, boxes = np.random.default_rng(seed), len(boxes), np.reshape(boxes, (-1, 7))
    columns = dict(
        boxes=boxes,
        labels=rng.choice(CLASSES, count).tolist(),
        scores=rng.random(count),
        header=make_any_header(make_bag_message, START, frame_id),
        **({"ids": rng.integers(0, 10**5, count), "covariances": rng.random((count, 6, 6))} if seed % 2 else {}),
    )
    assert encode_detection_array(**columns) == encode(to_detection_array(**columns, make=make_bag_message))
