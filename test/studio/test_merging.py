"""Merging of proposals with existing tracks, without a drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lidar_perception.types import Detections
from lidar_studio.actions import apply
from lidar_studio.interpolation import Motion
from lidar_studio.proposals import ProposalRequest, find_objects
from lidar_studio.proposer import merge_proposals
from lidar_studio.state import KEY, PROPOSED, Box, State, Track
from lidar_studio.survey import FrameSurvey

MOTION = Motion.of(np.arange(8) * 10**8)


def straight(x, y, frames, kind=PROPOSED, **more):
    """A track of an object that does not move."""
    boxes = {f: Box((x, y, -1.0, 0.8, 0.6, 1.7, 0.0), kind) for f in frames}
    return Track(0, "Pedestrian", boxes=boxes, **{"source": "fused", **more})


def with_id(track, number, **more):
    return replace(track, id=number, **more)


def test_proposals_keep_ids_and_edits_of_the_user():
    old = {
        1: with_id(straight(5, 0, range(8)), 1),
        2: with_id(straight(9, 0, range(8)), 2, state="rejected"),
        3: with_id(straight(20, 0, range(8)), 3),
        4: with_id(straight(30, 0, [2], kind=KEY), 4, state="accepted", source="click"),
        5: with_id(straight(40, 0, range(8)), 5, source="imported"),
    }
    state = State(old, next_id=6)
    new = [
        straight(5.1, 0, range(8)),
        straight(9.1, 0, range(8)),
        straight(30.1, 0, range(6)),
        straight(50, 0, range(8)),
        straight(40, 0.1, range(8)),
    ]
    tracks, removed = merge_proposals(state, new, MOTION)
    found = {t.id: t for t in tracks}
    assert removed == [3] and found.keys() == {1, 4, 6}
    assert found[1].boxes == new[0].boxes and found[6].boxes == new[3].boxes
    assert found[4].state == "accepted" and found[4].boxes.keys() == set(range(6))
    again = State({**{n: t for n, t in old.items() if n != 3}, **found}, next_id=7)
    assert merge_proposals(again, new, MOTION) == ([], [])


def test_single_boxes_without_a_click_are_not_tracked():
    old = {
        n: with_id(straight(5, 0, [n], kind=KEY), n, state="accepted", source=source)
        for n, source in enumerate(("imported", "fused", "person"), 1)
    }
    assert merge_proposals(State(old, next_id=4), [straight(5, 0, range(8))], MOTION) == ([], [])


@pytest.mark.parametrize(
    "work", [{"do": "class", "track": 1, "class": "Cyclist"}, {"do": "split", "track": 1, "frame": 4}]
)
def test_proposals_do_not_change_edited_tracks(work):
    state, _ = apply(State({1: with_id(straight(5, 0, range(8)), 1)}, next_id=2), work, MOTION)
    assert merge_proposals(state, [straight(5, 0, range(8))], MOTION) == ([], [])


def test_trimmed_click_is_not_tracked_beyond_the_cut():
    near = with_id(straight(5, 0, [2, 4], source="click"), 1, state="accepted", nearby=True)
    near = replace(near, boxes=near.boxes | straight(5, 0, [3], kind=KEY).boxes)
    state, _ = apply(State({1: near}, next_id=2), {"do": "trim", "track": 1, "frame": 3, "side": "after"}, MOTION)
    (found,), _ = merge_proposals(state, [straight(5, 0, range(8))], MOTION)
    assert sorted(found.boxes) == [0, 1, 2, 3] and not found.nearby


def test_two_clicks_in_one_frame_are_both_found():
    survey = FrameSurvey(Detections.none(), np.zeros((0, 7)), np.zeros((0, 80), np.uint32), {}, np.zeros((0, 7)))
    both = [(np.array([x, 0.0, -1, 0.8, 0.6, 1.7, 0]), "Pedestrian") for x in (5.0, 9.0)]
    found, _ = find_objects(survey, ProposalRequest(), both)
    assert found.boxes[:, 0].tolist() == [5.0, 9.0]
