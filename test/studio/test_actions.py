"""Actions of a labelling session: replay, undo, interpolation between frames."""

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
STAMPS = np.array([0, 100, 200, 350, 400, 500, 650, 700]) * 10**6  # uneven intervals
SIZE = [0.8, 0.6, 1.7]


def poses(turn=0.05, speed=8.0):
    """Poses of a sensor on a curve."""
    found = np.tile(np.eye(4), (FRAMES, 1, 1))
    for i, t in enumerate(STAMPS / 1e9):
        cos, sin = math.cos(turn * i), math.sin(turn * i)
        found[i, :2, :2] = [[cos, -sin], [sin, cos]]
        found[i, :2, 3] = [speed * t, 0.3 * t]
    return found


STANDING, DRIVING = Motion.of(STAMPS), Motion.of(STAMPS, poses())
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


def done(actions, motion, state=State()):
    """Return the state after all valid actions, and the list of these actions."""
    lines = []
    for action in actions:
        try:
            state, _ = apply(state, action, motion)
            lines.append(action)
        except InputError:
            pass
    return state, lines


def labels(state):
    """Return the part of the state that the page shows."""
    return dict(state.tracks), state.seeds, state.checked


def close(a, b, tolerance=1e-9):
    """Return True if two boxes are equal up to a tolerance."""
    apart = np.array(a) - np.array(b)
    apart[6] = wrap_angle(apart[6])
    return bool((np.abs(apart) <= tolerance).all())


@given(st.lists(ACTIONS, max_size=30), st.sampled_from([STANDING, DRIVING]))
def test_replaying_the_lines_gives_the_same_state(actions, motion):
    state, lines = done(actions, motion)
    again, _ = done(json.loads(json.dumps(lines)), motion)
    assert again == state
    for track in state.tracks.values():
        assert track_from_json(json.loads(json.dumps(track_to_json(track)))) == track
        assert all(np.isfinite(b.values).all() and min(b.values[3:6]) > 0 for b in track.boxes.values())
        assert not track.removed_frames & track.boxes.keys()


@given(st.lists(ACTIONS, max_size=25), st.sampled_from([STANDING, DRIVING]))
def test_undo_and_redo_are_inverses_at_any_depth(actions, motion):
    end, _ = done(actions, motion)
    seen, state = [labels(end)], end
    while state.undo_stack is not None:
        state, _ = apply(state, {"do": "undo"}, motion)
        seen.append(labels(state))
    assert labels(state) == labels(State())
    for expected in reversed(seen[:-1]):
        state, _ = apply(state, {"do": "redo"}, motion)
        assert labels(state) == expected
    assert state.next_id == end.next_id  # ids are never reused


@given(ACTIONS, st.lists(ACTIONS, max_size=8))
def test_invalid_action_changes_nothing(action, before):
    state, _ = done(before, DRIVING)
    kept = labels(state), state.seq
    try:
        apply(state, action, DRIVING)
    except InputError as error:
        assert "\n" not in str(error)
    assert (labels(state), state.seq) == kept


@pytest.mark.parametrize(
    "wrong",
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
def test_invalid_action_is_refused_in_one_line(wrong):
    with pytest.raises(InputError) as error:
        apply(State(), wrong, STANDING)
    assert "\n" not in str(error.value)


def walking(start, velocity, motion, kind=KEY):
    """Boxes by frame of an object with constant velocity in the fixed frame."""
    found = {}
    for f, t in enumerate(motion.times):
        fixed = np.array(
            [start[0] + velocity[0] * t, start[1] + velocity[1] * t, -0.9, *SIZE, math.atan2(velocity[1], velocity[0])]
        )
        box = fixed if motion.poses is None else transform_boxes(fixed, invert_pose(motion.poses[f]))[0]
        found[f] = Box.of(box, kind)
    return found


@given(
    st.tuples(metres, metres),
    st.tuples(st.floats(-3, 3), st.floats(-3, 3)),
    st.sampled_from([STANDING, DRIVING]),
    st.sets(frames, min_size=2),
    st.randoms(),
)
def test_constant_motion_is_exact_between_key_boxes_in_any_order(start, velocity, motion, keys, random):
    true = walking(start, velocity, motion)
    order = sorted(keys)
    random.shuffle(order)
    state, _ = done(
        [
            {"do": "add", "frame": order[0], "class": "Pedestrian", "box": list(true[order[0]].values)},
            *({"do": "box", "track": 1, "frame": f, "box": list(true[f].values)} for f in order[1:]),
        ],
        motion,
    )
    found = state.tracks[1].boxes
    assert found.keys() == set(range(min(keys), max(keys) + 1))
    for f, box in found.items():
        assert close(box.values, true[f].values, 1e-7)
        assert (box.kind == KEY) == (f in keys)
        if f in keys:
            assert box.values == true[f].values  # exactly


@given(
    st.tuples(st.floats(-1, 1), st.floats(-1, 1)), st.floats(-1.5, 1.5), frames, st.sampled_from([STANDING, DRIVING])
)
def test_correction_moves_a_whole_track_without_key_boxes(shift, turn, frame, motion):
    true = walking((5.0, 3.0), (1.0, 0.5), motion, PROPOSED)
    off = {}
    for f, box in true.items():
        wrong = motion.to_fixed(box.values, f) + [*shift, 0.1, 0.2, -0.1, 0.3, turn]
        off[f] = Box.of(motion.to_sensor(wrong, f), PROPOSED)
    state = State({1: Track(1, "Pedestrian", boxes=off)}, next_id=2)
    after, _ = apply(state, {"do": "box", "track": 1, "frame": frame, "box": list(true[frame].values)}, motion)
    for f, box in after.tracks[1].boxes.items():
        assert close(box.values, true[f].values, 1e-7)


def test_correction_ends_at_the_next_key_box():
    true = walking((5.0, 3.0), (1.0, 0.0), STANDING, PROPOSED)
    true[3] = replace_kind(true[3])
    state = State({1: Track(1, "Pedestrian", boxes=true)}, next_id=2)
    moved = list(true[6].values)
    moved[1] += 1.0
    after = apply(state, {"do": "box", "track": 1, "frame": 6, "box": moved}, STANDING)[0].tracks[1]
    assert all(after.boxes[f] == true[f] for f in range(4))
    shares = [after.boxes[f].values[1] - true[f].values[1] for f in range(3, 8)]
    assert np.allclose(shares, [0, 50 / 300, 150 / 300, 1, 1])


def replace_kind(box):
    return Box(box.values, KEY)


def test_frame_emptied_by_the_user_stays_empty():
    true = walking((5.0, 3.0), (1.0, 0.0), STANDING, PROPOSED)
    state = State({1: Track(1, "Pedestrian", boxes=true)}, next_id=2)
    state, _ = done(
        [
            {"do": "remove_box", "track": 1, "frame": 3},
            {"do": "box", "track": 1, "frame": 0, "box": list(true[0].values)},
            {"do": "box", "track": 1, "frame": 7, "box": list(true[7].values)},
        ],
        STANDING,
        state,
    )
    assert state.tracks[1].boxes.keys() == set(range(8)) - {3}


@given(st.sets(frames, min_size=2), st.integers(1, FRAMES - 1))
def test_split_and_merge_are_inverses(there, cut):
    true = walking((5.0, 3.0), (1.0, 0.5), DRIVING, PROPOSED)
    track = Track(1, "Pedestrian", boxes={f: true[f] for f in there}, removed_frames=frozenset({0}) - there)
    state = State({1: track}, seeds=((min(there), 1), (max(there), 1)), next_id=2)
    try:
        parts, _ = apply(state, {"do": "split", "track": 1, "frame": cut}, DRIVING)
    except InputError:
        assert min(there) >= cut or max(there) < cut
        return
    assert max(parts.tracks[1].boxes) < cut <= min(parts.tracks[2].boxes)
    whole, _ = apply(parts, {"do": "merge", "tracks": [1, 2]}, DRIVING)
    assert {1: replace(whole.tracks[1], edited=False)} == state.tracks
    assert set(whole.seeds) == set(state.seeds)
    again, _ = apply(whole, {"do": "split", "track": 1, "frame": cut}, DRIVING)
    assert again.tracks[1] == parts.tracks[1]
    assert again.tracks[3] == replace(parts.tracks[2], id=3)


def test_trim_keeps_the_same_boxes_as_split():
    true = walking((5.0, 3.0), (1.0, 0.5), DRIVING, PROPOSED)
    state = State({1: Track(1, "Pedestrian", boxes=true)}, seeds=((2, 1), (6, 1)), next_id=2)
    early, _ = apply(state, {"do": "trim", "track": 1, "frame": 3, "side": "after"}, DRIVING)
    late, _ = apply(state, {"do": "trim", "track": 1, "frame": 4, "side": "before"}, DRIVING)
    parts, _ = apply(state, {"do": "split", "track": 1, "frame": 4}, DRIVING)
    assert early.tracks[1].boxes == parts.tracks[1].boxes and early.seeds == ((2, 1),)
    assert late.tracks[1].boxes == parts.tracks[2].boxes and late.seeds == ((6, 1),)
    assert early.tracks[1].removed_frames == late.tracks[1].boxes.keys()
    for frame, side in ((7, "after"), (0, "before")):
        with pytest.raises(InputError, match="no boxes"):
            apply(state, {"do": "trim", "track": 1, "frame": frame, "side": side}, DRIVING)


def test_copied_box_stands_still_in_the_fixed_frame():
    box = [12.0, -3.0, -0.9, *SIZE, 0.4]
    state, _ = done(
        [
            {"do": "add", "frame": 1, "box": box, "class": "Car"},
            {"do": "copy", "track": 1, "from": 1, "to": 6},
            {"do": "copy", "track": 1, "from": 6, "to": 1},
        ],
        DRIVING,
    )
    found = state.tracks[1].boxes
    assert close(found[1].values, box)
    assert all(close(DRIVING.to_fixed(b.values, f), DRIVING.to_fixed(box, 1)) for f, b in found.items())


def test_next_uncertain_wraps_around():
    def track(number, score, **more):
        return Track(number, "Car", score=score, boxes={0: Box((9.0,) * 7, PROPOSED)}, **more)

    state = State({t.id: t for t in (track(1, 0.9), track(2, 0.45), track(3, 0.55), track(4, 0.5, state="accepted"))})
    seen = [find_next_uncertain(state, after).id for after in (None, 2, 3, 1, 4)]
    assert seen == [2, 3, 1, 2, 2]
    assert find_next_uncertain(State()) is None


def test_rest_of_a_class_is_rejected_and_restored_as_one_action():
    def track(number, name, **more):
        return Track(number, name, boxes={0: Box((9.0,) * 7, PROPOSED)}, **more)

    state = State(
        {t.id: t for t in (track(1, "Car"), track(2, "Van"), track(3, "Car"), track(4, "Car", state="accepted"))}
    )
    cars, _ = apply(state, {"do": "reject_rest", "class": "Car"}, STANDING)
    assert [t.state for t in cars.tracks.values()] == ["rejected", "proposed", "rejected", "accepted"]
    every, _ = apply(cars, {"do": "reject_rest"}, STANDING)
    assert every.tracks[2].state == "rejected" and every.tracks[4].state == "accepted"
    with pytest.raises(InputError, match="left to reject"):
        apply(every, {"do": "reject_rest"}, STANDING)
    back, _ = apply(cars, {"do": "undo"}, STANDING)
    assert back.tracks == state.tracks


@given(st.lists(ACTIONS, max_size=6), ACTIONS)
def test_joined_action_is_undone_with_the_previous_one(before, action):
    state, _ = done([*before, {"do": "add", "frame": 1, "box": [5, 0, 0, *SIZE, 0], "class": "Van"}], DRIVING)
    below = state.undo_stack[1]
    rest = {
        "do": "propose",
        "joins": True,
        "removed": [state.next_id - 1],
        "tracks": [Track(state.next_id, "Car", boxes={2: Box((9.0,) * 7, PROPOSED)})],
    }
    line = json.dumps(convert_tracks(rest, track_to_json))
    assert convert_tracks(json.loads(line), track_from_json) == rest
    both, _ = apply(state, rest, DRIVING)
    back, _ = apply(both, {"do": "undo"}, DRIVING)
    undone, _ = apply(state, {"do": "undo"}, DRIVING)
    assert labels(back) == labels(undone) and back.undo_stack == below
    again, _ = apply(back, {"do": "redo"}, DRIVING)
    assert labels(again) == labels(both)


def test_every_action_is_tested():
    tried = {"seed", "propose", "import"}  # tested in test_label_server.py
    named = {
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
    assert tried | named == HANDLERS.keys()
