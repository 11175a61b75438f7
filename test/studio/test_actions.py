"""Tests of the actions of a labelling session: replay, undo, interpolation between frames."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidar_perception.geometry import wrap_angle
from lidar_perception.robot.poses import invert_pose, transform_boxes
from lidar_perception.types import InputError
from lidar_studio.actions import HANDLERS, apply, convert_tracks
from lidar_studio.interpolation import Motion
from lidar_studio.state import KEY, PROPOSED, Box, State, Track, find_next_uncertain, track_from_json, track_to_json

FRAMES = 8
STAMPS = np.array([0, 100, 200, 350, 400, 500, 650, 700]) * 10**6  # ns, at irregular intervals
SIZE = [0.8, 0.6, 1.7]


def make_poses(turn=0.05, speed=8.0):
    """Return the poses of a sensor that drives along a curve."""
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    for i, t in enumerate(STAMPS / 1e9):
        cos, sin = math.cos(turn * i), math.sin(turn * i)
        poses[i, :2, :2] = [[cos, -sin], [sin, cos]]
        poses[i, :2, 3] = [speed * t, 0.3 * t]
    return poses


STANDING, DRIVING = Motion.from_stamps(STAMPS), Motion.from_stamps(STAMPS, make_poses())
frames = st.integers(0, FRAMES - 1)
tracks = st.integers(1, 6)
metres = st.floats(-50, 50)
sides = st.floats(0.1, 5)
boxes = st.tuples(metres, metres, metres, sides, sides, sides, st.floats(-3.1, 3.1)).map(list)
ACTIONS = st.one_of(
    st.fixed_dictionaries(
        {
            "do": st.just("add"),
            "frame": frames,
            "box": boxes,
            "class": st.sampled_from(["Car", "Pedestrian", "Marsmobil"]),
        }
    ),
    st.fixed_dictionaries({"do": st.sampled_from(["box", "snap"]), "track": tracks, "frame": frames, "box": boxes}),
    st.fixed_dictionaries({"do": st.just("size"), "track": tracks, "size": st.tuples(sides, sides, sides).map(list)}),
    st.fixed_dictionaries(
        {"do": st.sampled_from(["remove_box", "split", "interpolate"]), "track": tracks, "frame": frames}
    ),
    st.fixed_dictionaries({"do": st.just("copy"), "track": tracks, "from": frames, "to": frames}),
    st.fixed_dictionaries({"do": st.just("merge"), "tracks": st.tuples(tracks, tracks).map(list)}),
    st.fixed_dictionaries({"do": st.sampled_from(["accept", "reject", "reopen"]), "track": tracks}),
    st.fixed_dictionaries(
        {"do": st.just("trim"), "track": tracks, "frame": frames, "side": st.sampled_from(["before", "after"])}
    ),
    st.sampled_from([{"do": "reject_rest"}, {"do": "reject_rest", "class": "Van"}]),
    st.fixed_dictionaries({"do": st.just("class"), "track": tracks, "class": st.just("Van")}),
    st.fixed_dictionaries({"do": st.just("check"), "frame": frames, "checked": st.booleans()}),
    st.sampled_from([{"do": "undo"}, {"do": "redo"}]),
)


def apply_valid(actions, motion, state=State()):
    """Apply all valid actions; return the resulting state and these actions."""
    valid_actions = []
    for action in actions:
        try:
            state, _ = apply(state, action, motion)
            valid_actions.append(action)
        except InputError:
            pass
    return state, valid_actions


def get_labels(state):
    """Return the part of the state that the page shows."""
    return dict(state.tracks), state.seeds, state.checked_frames


def boxes_are_close(a, b, tolerance=1e-9):
    """Return True if two boxes are equal up to a tolerance."""
    difference = np.array(a) - np.array(b)
    difference[6] = wrap_angle(difference[6])
    return bool((np.abs(difference) <= tolerance).all())


@given(st.lists(ACTIONS, max_size=30), st.sampled_from([STANDING, DRIVING]))
def test_replayed_actions_give_the_same_state(actions, motion):
    state, valid_actions = apply_valid(actions, motion)
    replayed_state, _ = apply_valid(json.loads(json.dumps(valid_actions)), motion)
    assert replayed_state == state
    for track in state.tracks.values():
        assert track_from_json(json.loads(json.dumps(track_to_json(track)))) == track
        assert all(np.isfinite(b.values).all() and min(b.values[3:6]) > 0 for b in track.boxes.values())
        assert not track.removed_frames & track.boxes.keys()


@given(st.lists(ACTIONS, max_size=25), st.sampled_from([STANDING, DRIVING]))
def test_undo_and_redo_are_inverse_at_any_depth(actions, motion):
    last_state, _ = apply_valid(actions, motion)
    history, state = [get_labels(last_state)], last_state
    while state.undo_stack is not None:
        state, _ = apply(state, {"do": "undo"}, motion)
        history.append(get_labels(state))
    assert get_labels(state) == get_labels(State())
    for expected in reversed(history[:-1]):
        state, _ = apply(state, {"do": "redo"}, motion)
        assert get_labels(state) == expected
    assert state.next_id == last_state.next_id  # ids are never reused


@given(ACTIONS, st.lists(ACTIONS, max_size=8))
def test_invalid_action_changes_nothing(action, earlier_actions):
    state, _ = apply_valid(earlier_actions, DRIVING)
    expected = get_labels(state), state.seq
    try:
        apply(state, action, DRIVING)
    except InputError as error:
        assert "\n" not in str(error)
    assert (get_labels(state), state.seq) == expected


@pytest.mark.parametrize(
    "action",
    [
        {"do": "fly"},
        {},
        {"do": "add", "frame": 8, "box": [0, 0, 0, 1, 1, 1, 0], "class": "Car"},
        {"do": "add", "frame": -1, "box": [0, 0, 0, 1, 1, 1, 0], "class": "Car"},
        {"do": "add", "frame": True, "box": [0, 0, 0, 1, 1, 1, 0], "class": "Car"},
        {"do": "add", "frame": 0, "box": [math.nan, 0, 0, 1, 1, 1, 0], "class": "Car"},
        {"do": "add", "frame": 0, "box": [0, 0, 0, 1, 1, 0, 0], "class": "Car"},
        {"do": "add", "frame": 0, "box": [0, 0, 0, 1, 1, 1], "class": "Car"},
        {"do": "add", "frame": 0, "box": "box", "class": "Car"},
        {"do": "add", "frame": 0, "box": [0, 0, 0, 1, 1, 1, 0], "class": ""},
        {"do": "box", "track": 7, "frame": 0, "box": [0, 0, 0, 1, 1, 1, 0]},
        {"do": "merge", "tracks": [1, 1]},
        {"do": "merge", "tracks": [1]},
        {"do": "undo"},
        {"do": "check", "frame": 0, "checked": 1},
        {"do": "seed", "frame": 0, "xyz": [0, 0, 0], "class": "Car"},
    ],
    ids=str,
)
def test_invalid_action_raises_one_line_error(action):
    with pytest.raises(InputError) as error:
        apply(State(), action, STANDING)
    assert "\n" not in str(error.value)


def make_moving_boxes(start, velocity, motion, kind=KEY):
    """Return the boxes by frame of an object with constant velocity in the fixed frame."""
    moving_boxes = {}
    for f, t in enumerate(motion.times):
        fixed = np.array(
            [start[0] + velocity[0] * t, start[1] + velocity[1] * t, -0.9, *SIZE, math.atan2(velocity[1], velocity[0])]
        )
        box = fixed if motion.poses is None else transform_boxes(fixed, invert_pose(motion.poses[f]))[0]
        moving_boxes[f] = Box.from_array(box, kind)
    return moving_boxes


@given(
    st.tuples(metres, metres),
    st.tuples(st.floats(-3, 3), st.floats(-3, 3)),
    st.sampled_from([STANDING, DRIVING]),
    st.sets(frames, min_size=2),
    st.randoms(),
)
def test_constant_motion_is_interpolated_exactly(start, velocity, motion, key_frames, random):
    expected = make_moving_boxes(start, velocity, motion)
    order = sorted(key_frames)
    random.shuffle(order)
    state, _ = apply_valid(
        [
            {"do": "add", "frame": order[0], "class": "Pedestrian", "box": list(expected[order[0]].values)},
            *({"do": "box", "track": 1, "frame": f, "box": list(expected[f].values)} for f in order[1:]),
        ],
        motion,
    )
    track_boxes = state.tracks[1].boxes
    assert track_boxes.keys() == set(range(min(key_frames), max(key_frames) + 1))
    for f, box in track_boxes.items():
        assert boxes_are_close(box.values, expected[f].values, 1e-7)
        assert (box.kind == KEY) == (f in key_frames)
        if f in key_frames:
            assert box.values == expected[f].values  # exactly equal


@given(
    st.tuples(st.floats(-1, 1), st.floats(-1, 1)), st.floats(-1.5, 1.5), frames, st.sampled_from([STANDING, DRIVING])
)
def test_first_correction_moves_the_whole_track(shift, turn, frame, motion):
    expected = make_moving_boxes((5.0, 3.0), (1.0, 0.5), motion, PROPOSED)
    shifted_boxes = {}
    for f, box in expected.items():
        shifted_box = motion.to_fixed(box.values, f) + [*shift, 0.1, 0.2, -0.1, 0.3, turn]
        shifted_boxes[f] = Box.from_array(motion.to_sensor(shifted_box, f), PROPOSED)
    state = State({1: Track(1, "Pedestrian", boxes=shifted_boxes)}, next_id=2)
    state, _ = apply(state, {"do": "box", "track": 1, "frame": frame, "box": list(expected[frame].values)}, motion)
    for f, box in state.tracks[1].boxes.items():
        assert boxes_are_close(box.values, expected[f].values, 1e-7)


def test_correction_ends_at_the_next_key_box():
    boxes = make_moving_boxes((5.0, 3.0), (1.0, 0.0), STANDING, PROPOSED)
    boxes[3] = Box(boxes[3].values, KEY)
    state = State({1: Track(1, "Pedestrian", boxes=boxes)}, next_id=2)
    new_box = list(boxes[6].values)
    new_box[1] += 1.0
    track = apply(state, {"do": "box", "track": 1, "frame": 6, "box": new_box}, STANDING)[0].tracks[1]
    assert all(track.boxes[f] == boxes[f] for f in range(4))
    shifts = [track.boxes[f].values[1] - boxes[f].values[1] for f in range(3, 8)]
    assert np.allclose(shifts, [0, 50 / 300, 150 / 300, 1, 1])


def test_removed_box_is_not_interpolated_again():
    boxes = make_moving_boxes((5.0, 3.0), (1.0, 0.0), STANDING, PROPOSED)
    state = State({1: Track(1, "Pedestrian", boxes=boxes)}, next_id=2)
    state, _ = apply_valid(
        [
            {"do": "remove_box", "track": 1, "frame": 3},
            {"do": "box", "track": 1, "frame": 0, "box": list(boxes[0].values)},
            {"do": "box", "track": 1, "frame": 7, "box": list(boxes[7].values)},
        ],
        STANDING,
        state,
    )
    assert state.tracks[1].boxes.keys() == set(range(8)) - {3}


@given(st.sets(frames, min_size=2), st.integers(1, FRAMES - 1))
def test_merge_reverts_split(track_frames, split_frame):
    boxes = make_moving_boxes((5.0, 3.0), (1.0, 0.5), DRIVING, PROPOSED)
    removed_frames = frozenset({0}) - track_frames
    track = Track(1, "Pedestrian", boxes={f: boxes[f] for f in track_frames}, removed_frames=removed_frames)
    state = State({1: track}, seeds=((min(track_frames), 1), (max(track_frames), 1)), next_id=2)
    split_action = {"do": "split", "track": 1, "frame": split_frame}
    try:
        split_state, _ = apply(state, split_action, DRIVING)
    except InputError:
        assert min(track_frames) >= split_frame or max(track_frames) < split_frame
        return
    assert max(split_state.tracks[1].boxes) < split_frame <= min(split_state.tracks[2].boxes)
    merged_state, _ = apply(split_state, {"do": "merge", "tracks": [1, 2]}, DRIVING)
    assert {1: replace(merged_state.tracks[1], is_edited=False)} == state.tracks
    assert set(merged_state.seeds) == set(state.seeds)
    resplit_state, _ = apply(merged_state, split_action, DRIVING)
    assert resplit_state.tracks[1] == split_state.tracks[1]
    assert resplit_state.tracks[3] == replace(split_state.tracks[2], id=3)


def test_trim_and_split_keep_the_same_boxes():
    boxes = make_moving_boxes((5.0, 3.0), (1.0, 0.5), DRIVING, PROPOSED)
    state = State({1: Track(1, "Pedestrian", boxes=boxes)}, seeds=((2, 1), (6, 1)), next_id=2)
    early, _ = apply(state, {"do": "trim", "track": 1, "frame": 3, "side": "after"}, DRIVING)
    late, _ = apply(state, {"do": "trim", "track": 1, "frame": 4, "side": "before"}, DRIVING)
    parts, _ = apply(state, {"do": "split", "track": 1, "frame": 4}, DRIVING)
    assert early.tracks[1].boxes == parts.tracks[1].boxes and early.seeds == ((2, 1),)
    assert late.tracks[1].boxes == parts.tracks[2].boxes and late.seeds == ((6, 1),)
    assert early.tracks[1].removed_frames == late.tracks[1].boxes.keys()
    for frame, side in ((7, "after"), (0, "before")):
        with pytest.raises(InputError, match="no boxes"):
            apply(state, {"do": "trim", "track": 1, "frame": frame, "side": side}, DRIVING)


def test_copied_box_keeps_its_fixed_position():
    box = [12.0, -3.0, -0.9, *SIZE, 0.4]
    state, _ = apply_valid(
        [
            {"do": "add", "frame": 1, "box": box, "class": "Car"},
            {"do": "copy", "track": 1, "from": 1, "to": 6},
            {"do": "copy", "track": 1, "from": 6, "to": 1},
        ],
        DRIVING,
    )
    copies = state.tracks[1].boxes
    assert boxes_are_close(copies[1].values, box)
    assert all(boxes_are_close(DRIVING.to_fixed(b.values, f), DRIVING.to_fixed(box, 1)) for f, b in copies.items())


def test_search_for_next_uncertain_track_wraps_around():
    def track(number, score, **more):
        return Track(number, "Car", score=score, boxes={0: Box((9.0,) * 7, PROPOSED)}, **more)

    state = State({t.id: t for t in (track(1, 0.9), track(2, 0.45), track(3, 0.55), track(4, 0.5, state="accepted"))})
    next_ids = [find_next_uncertain(state, after).id for after in (None, 2, 3, 1, 4)]
    assert next_ids == [2, 3, 1, 2, 2]
    assert find_next_uncertain(State()) is None


def test_rejecting_the_rest_is_undone_as_one_action():
    def track(number, name, **more):
        return Track(number, name, boxes={0: Box((9.0,) * 7, PROPOSED)}, **more)

    state = State(
        {t.id: t for t in (track(1, "Car"), track(2, "Van"), track(3, "Car"), track(4, "Car", state="accepted"))}
    )
    without_cars, _ = apply(state, {"do": "reject_rest", "class": "Car"}, STANDING)
    assert [t.state for t in without_cars.tracks.values()] == ["rejected", "proposed", "rejected", "accepted"]
    all_decided, _ = apply(without_cars, {"do": "reject_rest"}, STANDING)
    assert all_decided.tracks[2].state == "rejected" and all_decided.tracks[4].state == "accepted"
    with pytest.raises(InputError, match="no undecided tracks"):
        apply(all_decided, {"do": "reject_rest"}, STANDING)
    undone, _ = apply(without_cars, {"do": "undo"}, STANDING)
    assert undone.tracks == state.tracks


@given(st.lists(ACTIONS, max_size=6), ACTIONS)
def test_joined_actions_are_undone_together(earlier_actions, action):
    state, _ = apply_valid(
        [*earlier_actions, {"do": "add", "frame": 1, "box": [5, 0, 0, *SIZE, 0], "class": "Van"}], DRIVING
    )
    previous_stack = state.undo_stack[1]
    joined_action = {
        "do": "propose",
        "joins": True,
        "removed": [state.next_id - 1],
        "tracks": [Track(state.next_id, "Car", boxes={2: Box((9.0,) * 7, PROPOSED)})],
    }
    line = json.dumps(convert_tracks(joined_action, track_to_json))
    assert convert_tracks(json.loads(line), track_from_json) == joined_action
    joined_state, _ = apply(state, joined_action, DRIVING)
    both_undone, _ = apply(joined_state, {"do": "undo"}, DRIVING)
    undone, _ = apply(state, {"do": "undo"}, DRIVING)
    assert get_labels(both_undone) == get_labels(undone) and both_undone.undo_stack == previous_stack
    redone, _ = apply(both_undone, {"do": "redo"}, DRIVING)
    assert get_labels(redone) == get_labels(joined_state)


def test_every_action_is_tested():
    tested_elsewhere = {"seed", "propose", "import"}  # in test_label_server.py
    tested_here = {
        "add",
        "box",
        "snap",
        "size",
        "remove_box",
        "split",
        "interpolate",
        "copy",
        "merge",
        "accept",
        "reject",
        "reject_rest",
        "trim",
        "reopen",
        "class",
        "check",
    }
    assert tested_elsewhere | tested_here == HANDLERS.keys()
