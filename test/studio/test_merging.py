"""Tests of merging proposals with existing tracks, without a drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidar_perception.types import Detections
from lidar_studio.actions import apply
from lidar_studio.interpolation import Motion
from lidar_studio.proposals import ProposalRequest, compute_size_similarity, find_objects
from lidar_studio.proposer import merge_proposals
from lidar_studio.state import KEY, PROPOSED, Box, State, Track
from lidar_studio.survey import FrameSurvey

MOTION = Motion.from_stamps(np.arange(8) * 10**8)


def make_static_track(x, y, frames, kind=PROPOSED, **fields):
    """Return a track of an object that does not move."""
    boxes = {f: Box((x, y, -1.0, 0.8, 0.6, 1.7, 0.0), kind) for f in frames}
    return Track(0, "Pedestrian", boxes=boxes, **{"source": "fused", **fields})


def with_id(track, track_id, **fields):
    return replace(track, id=track_id, **fields)


def test_new_proposals_keep_ids_and_manual_edits():
    old_tracks = {
        1: with_id(make_static_track(5, 0, range(8)), 1),
        2: with_id(make_static_track(9, 0, range(8)), 2, state="rejected"),
        3: with_id(make_static_track(20, 0, range(8)), 3),
        4: with_id(make_static_track(30, 0, [2], kind=KEY), 4, state="accepted", source="click"),
        5: with_id(make_static_track(40, 0, range(8)), 5, source="imported"),
    }
    state = State(old_tracks, next_id=6)
    proposals = [
        make_static_track(5.1, 0, range(8)),
        make_static_track(9.1, 0, range(8)),
        make_static_track(30.1, 0, range(6)),
        make_static_track(50, 0, range(8)),
        make_static_track(40, 0.1, range(8)),
    ]
    changed_tracks, removed_ids = merge_proposals(state, proposals, MOTION)
    tracks = {t.id: t for t in changed_tracks}
    assert removed_ids == [3] and tracks.keys() == {1, 4, 6}
    assert tracks[1].boxes == proposals[0].boxes and tracks[6].boxes == proposals[3].boxes
    assert tracks[4].state == "accepted" and tracks[4].boxes.keys() == set(range(6))
    merged_state = State({**{n: t for n, t in old_tracks.items() if n != 3}, **tracks}, next_id=7)
    assert merge_proposals(merged_state, proposals, MOTION) == ([], [])


def test_single_boxes_without_a_click_are_not_tracked():
    tracks = {
        n: with_id(make_static_track(5, 0, [n], kind=KEY), n, state="accepted", source=source)
        for n, source in enumerate(("imported", "fused", "person"), 1)
    }
    assert merge_proposals(State(tracks, next_id=4), [make_static_track(5, 0, range(8))], MOTION) == ([], [])


@pytest.mark.parametrize(
    "edit", [{"do": "class", "track": 1, "class": "Cyclist"}, {"do": "split", "track": 1, "frame": 4}]
)
def test_proposals_do_not_change_edited_tracks(edit):
    state, _ = apply(State({1: with_id(make_static_track(5, 0, range(8)), 1)}, next_id=2), edit, MOTION)
    assert merge_proposals(state, [make_static_track(5, 0, range(8))], MOTION) == ([], [])


def test_trimmed_track_is_not_extended_beyond_the_trim():
    track = with_id(make_static_track(5, 0, [2, 4], source="click"), 1, state="accepted", is_partly_tracked=True)
    track = replace(track, boxes=track.boxes | make_static_track(5, 0, [3], kind=KEY).boxes)
    state, _ = apply(State({1: track}, next_id=2), {"do": "trim", "track": 1, "frame": 3, "side": "after"}, MOTION)
    (extended_track,), _ = merge_proposals(state, [make_static_track(5, 0, range(8))], MOTION)
    assert sorted(extended_track.boxes) == [0, 1, 2, 3] and not extended_track.is_partly_tracked


def test_two_clicks_in_one_frame_create_two_tracks():
    survey = FrameSurvey(Detections.none(), np.zeros((0, 7)), np.zeros((0, 80), np.uint32), {}, np.zeros((0, 7)))
    placed_boxes = [(np.array([x, 0.0, -1, 0.8, 0.6, 1.7, 0]), "Pedestrian") for x in (5.0, 9.0)]
    objects, _ = find_objects(survey, ProposalRequest(), placed_boxes)
    assert objects.boxes[:, 0].tolist() == [5.0, 9.0]


@given(st.floats(0.5, 12), st.floats(0.3, 3), st.floats(0.5, 4), st.floats(0.2, 1.2))
def test_clusters_of_equal_size_are_most_similar(length, width, height, factor):
    length, width = max(length, width), min(length, width)
    size = length, width, height
    shape = np.array([[9.0, 0, 0, *size, 0.3]])
    assert compute_size_similarity(shape, size) == pytest.approx(1.0)
    scaled_shape = shape * [1, 1, 1, factor, 1, 1, 1]
    assert 0 <= compute_size_similarity(scaled_shape, size)[0] <= 1
    similarities = [compute_size_similarity(shape * [1, 1, 1, s, s, s, 1], size)[0] for s in (1.0, 1.1, 1.3, 1.6)]
    assert similarities == sorted(similarities, reverse=True) and similarities[-1] < 0.1
