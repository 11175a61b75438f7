"""Laws of what is kept of a drive: what is there, wherever one begins to count, and no post."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adapting_samples import FRAMES, KINDS, PARKED, POST, boxes_at, drive, points_in
from tracking_samples import pose

from lidar_perception.adapting.judging import IGNORED, KEPT, REJECTED, judged
from lidar_perception.adapting.labels import labels_of
from lidar_perception.adapting.looking import seen_in
from lidar_perception.adapting.tracks import tracks_of
from lidar_perception.robot.poses import inverse, moved_boxes


def judge(looks, stamps):
    """Objects by where they are at first, from right to left, and what is made of them."""
    start = inverse(looks[0].pose)
    way = np.array([(start @ look.pose)[:2, 3] for look in looks])
    tracks = sorted(tracks_of(looks, stamps), key=lambda t: t.boxes[0, 1])
    return tracks, [judged(t, way) for t in tracks]


BY_SIDE = np.argsort(boxes_at(0.0)[:, 1])


def test_what_is_there_is_kept_and_a_post_is_not():
    looks, stamps, _ = drive()
    tracks, verdicts = judge(looks, stamps)
    assert [t.class_id for t in tracks] == KINDS[BY_SIDE].tolist()
    assert all(len(t) == FRAMES for t in tracks)
    states = dict(zip(BY_SIDE.tolist(), (v.state for v in verdicts)))
    assert states.pop(POST) == REJECTED and set(states.values()) == {KEPT}
    assert "post" in verdicts[BY_SIDE.tolist().index(POST)].reason


@pytest.mark.parametrize("scores, state", [(0.3, IGNORED), (0.07, REJECTED)])
def test_what_no_source_is_sure_of_is_not_kept(scores, state):
    looks, stamps, _ = drive(scores)
    look = [replace(each, detections=replace(
        each.detections, scores=each.detections.scores)) for each in looks]
    _, verdicts = judge(look, stamps)
    assert KEPT not in {v.state for v in verdicts}
    if scores == 0.3:
        assert [v.state for v in verdicts].count(state) == 4  # all but the post


def test_neither_where_the_drive_lies_nor_when_it_was_changes_a_verdict():
    looks, stamps, _ = drive(missed=5)
    expected = [v.state for v in judge(looks, stamps)[1]]
    elsewhere, _, _ = drive(missed=5, start=pose(-300.0, 70.0, 2.5))
    assert [v.state for v in judge(elsewhere, [s + 10**15 for s in stamps])[1]] == expected


def test_a_source_that_is_against_leaves_an_object_undecided():
    looks, stamps, _ = drive()
    against = [replace(each, detections=replace(each.detections, sources={
        **each.detections.sources, "classifier": np.full(5, 0.1, np.float32)})) for each in looks]
    assert KEPT not in {v.state for v in judge(against, stamps)[1]}


def test_labels_are_where_the_objects_are_also_where_they_were_not_detected():
    looks, stamps, poses = drive(missed=7)
    tracks, verdicts = judge(looks, stamps)
    labels = labels_of(tracks, verdicts, poses, np.arange(FRAMES) / 10)
    for i, own in enumerate(labels):
        truth = moved_boxes(boxes_at(i / 10), inverse(poses[i]))[BY_SIDE]
        order = np.argsort(own.numbers)
        assert len(own) == 5
        assert np.abs(own.boxes[order, :3] - truth[:, :3]).max() < 0.15
        concluded = np.flatnonzero(~own.seen)
        assert concluded.tolist() == ([int(np.flatnonzero(
            own.numbers == BY_SIDE.tolist().index(PARKED))[0])] if i == 7 else [])


def test_what_stands_has_one_box_in_the_fixed_frame():
    looks, stamps, poses = drive(noise=0.05)
    tracks, verdicts = judge(looks, stamps)
    labels = labels_of(tracks, verdicts, poses, np.arange(FRAMES) / 10)
    parked = BY_SIDE.tolist().index(PARKED)
    fixed = [moved_boxes(own.boxes[own.numbers == parked], at)[0]
             for own, at in zip(labels, poses)]
    assert np.ptp(fixed, axis=0).max() < 1e-6


def test_the_top_of_a_thing_ends_where_points_do():
    rng = np.random.default_rng(1)
    box = boxes_at(0.0)[:1]
    person, post = points_in(box[0], rng), points_in(box[0], rng, 2.5)
    crown = person + [0, 0, 3.0]  # above a person, with a gap
    assert seen_in(box, person.astype(np.float32))[1][0] == pytest.approx(1.74, abs=0.1)
    assert seen_in(box, post.astype(np.float32))[1][0] == pytest.approx(4.24, abs=0.2)
    both = np.concatenate([person, crown]).astype(np.float32)
    counts, tops = seen_in(box, both)
    assert counts[0] == 200 and tops[0] == pytest.approx(1.74, abs=0.1)
    assert seen_in(np.zeros((0, 7)), both)[0].shape == (0,)
