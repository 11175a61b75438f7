"""Conversion of boxes to markers and detections and back, also in successive arrays."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import STAMP, each_make, make_any_header

from lidar_perception.types import CLASSES, GroundTruth
from lidar_perception.wire import codec
from lidar_perception.wire.messages import make_truth_markers, to_detections, to_truth
from msg_utils.detections import from_detection_array, to_detection_array
from msg_utils.markers import (
    ADD,
    CUBE,
    DELETE,
    compute_yaw,
    from_marker_array,
    list_marker_keys,
    make_box_pose,
    to_marker_array,
)

pytestmark = pytest.mark.no_cover  # covered by other tests

metres = st.floats(-200, 200)
yaws = st.floats(-math.pi, math.pi, exclude_min=True) | st.sampled_from([math.pi, 0.0])
boxes = st.tuples(metres, metres, metres, *[st.floats(0.01, 30)] * 3, yaws)
words = st.text(st.characters(exclude_categories=("Cs", "Cc")), max_size=8)
json_values = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**6), 10**6) | words | st.floats(allow_nan=False),
    lambda inner: st.lists(inner, max_size=3),
)
contents = st.dictionaries(words.filter(lambda key: key != "score"), json_values, max_size=3)
objects = st.lists(st.tuples(boxes, st.sampled_from(CLASSES) | words, st.floats(0, 1), contents), max_size=5)
notes = st.lists(st.tuples(words, contents), max_size=2)


def make_array(make, rows, **more):
    return to_marker_array(
        np.array([box for box, *_ in rows]), [r[1] for r in rows], header=make_any_header(make), make=make, **more
    )


def keys(rows):
    return [(label, i) for i, (_, label, *_) in enumerate(rows)]


def are_equal_boxes(a, b) -> bool:
    """Return True for equal boxes, up to rounding of the yaw, with pi equal to -pi."""
    a, b = (np.reshape(x, (-1, 7)) for x in (a, b))
    yaw_difference = np.abs((a[:, 6] - b[:, 6] + np.pi) % (2 * np.pi) - np.pi)
    return np.array_equal(a[:, :6], b[:, :6]) and bool((yaw_difference < 1e-12).all())


@each_make
@given(rows=objects, remarks=notes)
def test_marker_array_survives_conversion_and_back(make, rows, remarks):
    result = from_marker_array(
        make_array(
            make,
            rows,
            scores=[r[2] for r in rows],
            extras=[r[3] for r in rows],
            notes=remarks,
            ids=range(7, 7 + len(rows)),
        )
    )
    assert are_equal_boxes(result.boxes, [r[0] for r in rows])
    assert result.labels == [r[1] for r in rows]
    assert result.scores.tolist() == [r[2] for r in rows]
    assert result.extras == [{**r[3], "score": r[2]} for r in rows]
    assert result.notes == remarks
    assert result.ids.tolist() == list(range(7, 7 + len(rows)))
    assert (result.stamp_ns, result.frame_id) == (STAMP, "velodyne")


@given(rows=objects, remarks=notes)
def test_markers_survive_serialization(rows, remarks):
    sent = make_array(
        codec.make_bag_message, rows, scores=[r[2] for r in rows], extras=[r[3] for r in rows], notes=remarks
    )
    raw = codec.encode(sent)
    read = codec.decode(raw, "visualization_msgs/msg/MarkerArray")
    assert codec.encode(read) == raw
    before, after = from_marker_array(sent), from_marker_array(read)
    assert np.array_equal(before.boxes, after.boxes)
    assert (before.labels, before.extras, before.notes) == (after.labels, after.extras, after.notes)


@each_make
@given(yaw=yaws)
def test_quaternion_is_normalized_and_rotates_about_z_only(make, yaw):
    pose = make_box_pose(np.array([1.0, 2, 3, 4, 5, 6, yaw]), make)
    q = pose.orientation
    assert q.x == q.y == 0 and math.hypot(q.z, q.w) == pytest.approx(1, abs=1e-15)
    forward = (1 - 2 * q.z * q.z, 2 * q.z * q.w)  # the rotated x axis
    assert forward == pytest.approx((math.cos(yaw), math.sin(yaw)), abs=1e-12)
    q.z, q.w = -q.z, -q.w  # the same rotation
    assert math.remainder(compute_yaw(pose) - yaw, math.tau) == pytest.approx(0, abs=1e-12)


@each_make
@given(before=objects, after=objects)
def test_only_outdated_markers_are_deleted(make, before, after):
    first = make_array(make, before)
    second = make_array(make, after, previous=list_marker_keys(first))
    assert list_marker_keys(first) == {*keys(before)}
    deleted = [(m.ns, m.id) for m in second.markers if m.action == DELETE]
    gone = {*keys(before)} - {*keys(after)}
    assert sorted(deleted) == sorted(gone or ({("", 0)} if not after else ()))
    assert list_marker_keys(second) == {*keys(after)}
    assert len(from_marker_array(second)) == len(after) and not from_marker_array(second).notes


@each_make
def test_empty_array_keeps_frame_and_stamp(make):
    msg = make_array(make, [])
    result = from_marker_array(msg)
    assert len(result) == 0 and result.boxes.shape == (0, 7) and result.notes == []
    assert (result.stamp_ns, result.frame_id) == (STAMP, "velodyne")
    assert list_marker_keys(msg) == frozenset()


@each_make
def test_message_without_markers_has_no_detections(make):
    result = from_marker_array(make("visualization_msgs/msg/MarkerArray", markers=[]))
    assert (len(result), result.stamp_ns, result.frame_id) == (0, 0, "")


@each_make
@pytest.mark.parametrize(
    "text, score, extra",
    [
        ("", 1.0, {}),
        ("car 7", 1.0, {"text": "car 7"}),
        ("{broken", 1.0, {"text": "{broken"}),
        ("12", 1.0, {"text": "12"}),
        ("[1, 2]", 1.0, {"text": "[1, 2]"}),
        ('{"score": 0.25, "id": 3}', 0.25, {"score": 0.25, "id": 3}),
        ('{"score": 1}', 1.0, {"score": 1}),
        ('{"score": "high"}', 1.0, {"score": "high"}),
        ('{"score": null}', 1.0, {"score": None}),
        ('{"score": 1%s}' % ("0" * 400), 1.0, {"score": 10**400}),
        *((endless, 1.0, {"text": endless}) for endless in ('{"a":' * 9000, "1" * 5000)),
    ],
    ids=range(12),
)
def test_cubes_of_other_nodes_are_read(make, text, score, extra):
    cube = make(
        "visualization_msgs/msg/Marker",
        header=make_any_header(make, 5, "map"),
        ns="car",
        id=4,
        type=CUBE,
        action=ADD,
        text=text,
        pose=make_box_pose(np.array([1.0, 2, 3, 4, 5, 6, -2.0]), make),
        scale=make("geometry_msgs/msg/Vector3", x=4.0, y=5.0, z=6.0),
    )
    sphere = make("visualization_msgs/msg/Marker", header=make_any_header(make), type=2, action=ADD)
    clear = make("visualization_msgs/msg/Marker", action=3)  # DELETEALL, often without a header
    result = from_marker_array(make("visualization_msgs/msg/MarkerArray", markers=[clear, cube, sphere]))
    assert are_equal_boxes(result.boxes, [[1, 2, 3, 4, 5, 6, -2.0]])
    assert (result.labels, result.ids.tolist(), result.frame_id, result.stamp_ns) == (["car"], [4], "map", 5)
    assert result.scores.tolist() == [score] and result.extras == [extra]
    assert CLASSES[to_truth(result).class_ids[0]] == "Car"
    assert to_detections(result).scores.tolist() == [score]


@each_make
def test_arrays_of_different_length_are_rejected(make):
    with pytest.raises(ValueError):
        to_marker_array(np.zeros((2, 7)), ["Car"], header=make_any_header(make), make=make)


@each_make
def test_each_cube_has_the_given_lifetime_and_color(make):
    rows = [((0, 0, 0, 1, 1, 1, 0), label, 1.0, {}) for label in ("Car", "unheard of")]
    msg = make_array(make, rows, color=(0.25, 0.5, 1.0), lifetime_ns=1_500_000_000)
    for m in msg.markers:
        assert (m.lifetime.sec, m.lifetime.nanosec) == (1, 500_000_000)
        assert (m.color.r, m.color.g, m.color.b) == (0.25, 0.5, 1.0) and 0 < m.color.a < 1


@each_make
@pytest.mark.parametrize("tracks, ids", [([4, 9], [4, 9]), ([4, None], [0, 1]), ([4, 4], [0, 1]), ([], [])])
def test_unique_track_ids_become_detection_ids(make, tracks, ids):
    extras = [{} if t is None else {"track_id": t} for t in tracks]
    truth = GroundTruth.of(np.ones((len(tracks), 7)), [0] * len(tracks), extras, [("DontCare", {"track_id": -1})])
    result = from_marker_array(make_truth_markers(truth, make_any_header(make), make))
    assert result.ids.tolist() == ids
    assert to_truth(result).extras == truth.extras and to_truth(result).notes == truth.notes


@given(rows=objects)
def test_detection_array_survives_conversion_and_back(rows):
    msg = to_detection_array(
        np.array([r[0] for r in rows]),
        [r[1] for r in rows],
        [r[2] for r in rows],
        header=make_any_header(codec.make_bag_message),
        make=codec.make_bag_message,
    )
    for read in (msg, codec.decode(codec.encode(msg), "vision_msgs/msg/Detection3DArray")):
        result = from_detection_array(read)
        assert [d.id for d in read.detections] == [str(i) for i in range(len(rows))]
        assert result.ids.tolist() == list(range(len(rows))) and result.extras == [{}] * len(rows)
        assert not any(np.any(r.pose.covariance) for d in read.detections for r in d.results)
        assert are_equal_boxes(result.boxes, [r[0] for r in rows])
        assert result.labels == [r[1] for r in rows]
        assert result.scores.tolist() == [r[2] for r in rows]
        assert (result.stamp_ns, result.frame_id) == (STAMP, "velodyne")


def test_detection_has_its_most_likely_class():
    msg = to_detection_array(
        np.ones((2, 7)),
        ["Car", "Van"],
        [0.3, 0.5],
        header=make_any_header(codec.make_bag_message),
        make=codec.make_bag_message,
    )
    msg.detections[0].results.extend(msg.detections[1].results)
    msg.detections[1].results.clear()
    result = from_detection_array(msg)
    assert (result.labels, result.scores.tolist()) == (["Van", ""], [0.5, 1.0])
