"""Actions of a labelling session: apply(state, action, motion) returns the next state.

An action is a dict with the fields of one journal entry. It contains all computed values, so a
journal can be replayed without a detector. Tracks in it are Track objects; convert_tracks() converts
them to and from JSON.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from lidar_perception.types import MAX_RANGE, InputError
from lidar_studio.interpolation import Motion, apply_correction, reinterpolate_frame
from lidar_studio.state import ACCEPTED, KEY, PROPOSED, REJECTED, Box, Change, Seeds, Stack, State, Track

Action = Mapping[str, Any]
TrackChanges = dict[int, Track | None]  # track id -> new track, or None to remove it
MAX_CLASS_LENGTH = 100  # characters
ACTIONS_WITH_TRACKS = "seed", "propose", "import"  # `merge` has a field `tracks` too, but it contains ids


def convert_tracks(action: Action, convert: Callable[[Any], Any]) -> Action:
    """Return a copy of an action or journal entry with `convert` applied to its tracks."""
    if action.get("do") not in ACTIONS_WITH_TRACKS or "tracks" not in action:
        return action
    return {**action, "tracks": [convert(track) for track in action["tracks"]]}


def apply(state: State, action: Action, motion: Motion) -> tuple[State, Change]:
    """Apply an action; return the next state and the change. Raises InputError if the action is invalid."""
    name, motion = action.get("do"), with_scan_poses(state, motion)
    if name == "poses":  # not a manual edit, so it cannot be undone
        poses = tuple(tuple(map(float, row)) for row in action["poses"])
        return replace(state, poses=poses, seq=state.seq + 1), Change(
            {},
            (state.seeds, state.seeds),
            (state.checked_frames, state.checked_frames),
            (state.preserved_fields, state.preserved_fields),
        )
    if name == "undo" or name == "redo":
        return _undo(state) if name == "undo" else _redo(state)
    if name not in HANDLERS:
        raise InputError(f"unknown action {str(name)[:40]!r}; known actions: {', '.join((*HANDLERS, 'undo', 'redo'))}")
    tracks, seeds, checked_frames = HANDLERS[name](state, action, motion)
    change = Change(
        {n: (state.tracks.get(n), track) for n, track in tracks.items() if state.tracks.get(n) != track},
        (state.seeds, seeds),
        (state.checked_frames, checked_frames),
        (
            state.preserved_fields,
            action.get("kept", state.preserved_fields) if name == "import" else state.preserved_fields,
        ),
    )
    undo_stack: Stack = (change, state.undo_stack)
    redo_stack: Stack = None
    if action.get("joins") and state.undo_stack is not None:  # completes the previous action
        undo_stack = state.undo_stack[0].combine_with(change), state.undo_stack[1]
    elif action.get("beside"):  # not an action of a person, so it does not affect undo and redo
        undo_stack, redo_stack = state.undo_stack, state.redo_stack
    return replace(state.with_change(change), seq=state.seq + 1, undo_stack=undo_stack, redo_stack=redo_stack), change


def with_scan_poses(state: State, motion: Motion) -> Motion:
    """Return the motion, with poses from scan matching added if the drive has none."""
    if motion.poses is not None or len(state.poses) != len(motion.times):
        return motion
    return Motion(motion.times, np.array(state.poses, np.float64).reshape(-1, 4, 4))


def _undo(state: State) -> tuple[State, Change]:
    if state.undo_stack is None:
        raise InputError("nothing to undo")
    change, remaining_stack = state.undo_stack
    inverse = change.invert()
    return replace(
        state.with_change(inverse), seq=state.seq + 1, undo_stack=remaining_stack, redo_stack=(change, state.redo_stack)
    ), inverse


def _redo(state: State) -> tuple[State, Change]:
    if state.redo_stack is None:
        raise InputError("nothing to redo")
    change, remaining_stack = state.redo_stack
    return replace(
        state.with_change(change), seq=state.seq + 1, undo_stack=(change, state.undo_stack), redo_stack=remaining_stack
    ), change


Outcome = tuple[TrackChanges, Seeds, frozenset[int]]  # changed tracks, all seeds, all checked frames


def _replace_tracks(state: State, *tracks: Track) -> Outcome:
    return {track.id: track for track in tracks}, state.seeds, state.checked_frames


def require_frame(action: Action, motion: Motion, name: str = "frame") -> int:
    """Return the frame index in field `name` of an action, or raise InputError if the drive has no such frame."""
    frame, frame_count = action.get(name), len(motion.times)
    if not isinstance(frame, int) or isinstance(frame, bool) or not 0 <= frame < frame_count:
        raise InputError(f"frame {str(frame)[:40]} does not exist; valid frames are 0 to {frame_count - 1}")
    return frame


def require_track(state: State, track_id: Any) -> Track:
    """Return the track with an id, or raise InputError if it does not exist."""
    if not isinstance(track_id, int) or isinstance(track_id, bool) or track_id not in state.tracks:
        raise InputError(f"track {str(track_id)[:40]} does not exist; reload the page")
    return state.tracks[track_id]


def require_box(track: Track, frame: int) -> Box:
    """Return the box of a track in a frame, or raise InputError if it has none."""
    if frame not in track.boxes:
        raise InputError(f"track {track.id} has no box in frame {frame}; copy a box to this frame first")
    return track.boxes[frame]


def require_numbers(action: Action, name: str, count: int) -> tuple[float, ...]:
    """Return the `count` numbers in field `name` of an action.

    Raises:
        InputError: The field is not a list of `count` numbers between -MAX_RANGE and MAX_RANGE.
    """
    values = action.get(name)
    if (
        not isinstance(values, list | tuple)
        or len(values) != count
        or not all(isinstance(v, int | float) and not isinstance(v, bool) and abs(v) <= MAX_RANGE for v in values)
    ):
        raise InputError(
            f"{name} must be {count} numbers between -{MAX_RANGE:g} and {MAX_RANGE:g}, not {str(values)[:80]}"
        )
    return tuple(map(float, values))


def require_positive_size(size: tuple[float, ...]) -> None:
    """Raise InputError unless length, width and height are positive."""
    if min(size) <= 0:
        raise InputError(f"length, width and height must be positive, not {list(size)}")


def require_box_values(action: Action) -> tuple[float, ...]:
    """Return the box of an action, or raise InputError if it is invalid."""
    values = require_numbers(action, "box", 7)
    require_positive_size(values[3:6])
    return values


def require_class_name(action: Action) -> str:
    """Return the class name in an action, or raise InputError if it is empty, too long or not a string."""
    name = action.get("class")
    if not isinstance(name, str) or not name.strip() or len(name) > MAX_CLASS_LENGTH:
        raise InputError(f"invalid class name {str(name)[:40]!r}: expected 1 to {MAX_CLASS_LENGTH} characters")
    return name


def _get_computed_tracks(state: State, action: Action) -> TrackChanges:
    changes: TrackChanges = {int(n): None for n in action.get("removed", ())}
    changes |= {track.id: track for track in action.get("tracks", ())}
    return changes


def _replace_with_computed(state: State, action: Action, motion: Motion) -> Outcome:
    return _get_computed_tracks(state, action), state.seeds, state.checked_frames


def _add_seed_track(state: State, action: Action, motion: Motion) -> Outcome:
    frame, track_id = require_frame(action, motion), action.get("track")
    if not isinstance(track_id, int):
        raise InputError("a seed action requires the integer field `track`, which the server adds")
    return _get_computed_tracks(state, action), add_seed(state.seeds, frame, track_id), state.checked_frames


def add_seed(seeds: Seeds, frame: int, track: int) -> Seeds:
    """Return the seeds with (frame, track) added unless they already contain it."""
    return seeds if (frame, track) in seeds else (*seeds, (frame, track))


def _add_track(state: State, action: Action, motion: Motion) -> Outcome:
    frame, box = require_frame(action, motion), Box(require_box_values(action), KEY)
    return _replace_tracks(
        state, Track(state.next_id, require_class_name(action), ACCEPTED, 1.0, "person", {frame: box})
    )


def _set_box(state: State, action: Action, motion: Motion) -> Outcome:
    track, frame = require_track(state, action.get("track")), require_frame(action, motion)
    removed_frames = track.removed_frames - {frame}
    boxes = apply_correction(track.boxes, removed_frames, frame, require_box_values(action), motion)
    return _replace_tracks(state, replace(track, boxes=boxes, removed_frames=removed_frames))


def _set_size(state: State, action: Action, motion: Motion) -> Outcome:
    track = require_track(state, action.get("track"))
    size = require_numbers(action, "size", 3)
    require_positive_size(size)
    boxes = {}
    for frame, box in track.boxes.items():
        x, y, z, _, _, height, yaw = box.values
        boxes[frame] = Box((x, y, z + (size[2] - height) / 2, *size, yaw), box.kind)
    return _replace_tracks(state, replace(track, boxes=boxes))


def _remove_box(state: State, action: Action, motion: Motion) -> Outcome:
    track, frame = require_track(state, action.get("track")), require_frame(action, motion)
    require_box(track, frame)
    boxes = {f: b for f, b in track.boxes.items() if f != frame}
    if not boxes:
        return {track.id: None}, _drop_seeds(state.seeds, track.id), state.checked_frames
    removed_frames = track.removed_frames | {frame}
    return _replace_tracks(state, replace(track, boxes=boxes, removed_frames=removed_frames))


def _interpolate_track(state: State, action: Action, motion: Motion) -> Outcome:
    track, frame = require_track(state, action.get("track")), require_frame(action, motion)
    removed_frames = track.removed_frames - {frame}
    boxes = reinterpolate_frame(track.boxes, removed_frames, frame, motion)
    if boxes is None:
        raise InputError(
            f"frame {frame} of track {track.id} cannot be interpolated: it needs a key box before and after"
        )
    return _replace_tracks(state, replace(track, boxes=boxes, removed_frames=removed_frames))


def _drop_seeds(seeds: Seeds, track: int) -> Seeds:
    return tuple(seed for seed in seeds if seed[1] != track)


def _copy_box(state: State, action: Action, motion: Motion) -> Outcome:
    track = require_track(state, action.get("track"))
    source, target = require_frame(action, motion, "from"), require_frame(action, motion, "to")
    box = motion.to_sensor(motion.to_fixed(require_box(track, source).values, source), target)
    return _set_box(state, {"track": track.id, "frame": target, "box": box.tolist()}, motion)


def _set_class(state: State, action: Action, motion: Motion) -> Outcome:
    track = require_track(state, action.get("track"))
    return _replace_tracks(
        state,
        replace(track, class_name=require_class_name(action), is_edited=track.is_edited or track.state == PROPOSED),
    )


def _reject_rest(state: State, action: Action, motion: Motion) -> Outcome:
    class_name = require_class_name(action) if "class" in action else None
    undecided_tracks = [t for t in state.tracks.values() if t.state == PROPOSED and class_name in (None, t.class_name)]
    if not undecided_tracks:
        raise InputError(f"no undecided tracks{f' of class {class_name}' if class_name else ''} to reject")
    return _replace_tracks(state, *(replace(t, state=REJECTED) for t in undecided_tracks))


def _accept_track(state: State, action: Action, motion: Motion, new_state: str = ACCEPTED) -> Outcome:
    track, seeds = require_track(state, action.get("track")), state.seeds
    if action.get("seed") is not None:  # the frame in which the object is nearest
        seeds = add_seed(seeds, require_frame(action, motion, "seed"), track.id)
    return {track.id: replace(track, state=new_state)}, seeds, state.checked_frames


def _reject_track(state: State, action: Action, motion: Motion) -> Outcome:
    track = require_track(state, action.get("track"))
    seeds = _drop_seeds(state.seeds, track.id)
    return {track.id: replace(track, state=REJECTED)}, seeds, state.checked_frames


def _reopen_track(state: State, action: Action, motion: Motion) -> Outcome:
    return _accept_track(state, action, motion, PROPOSED)


def _merge_tracks(state: State, action: Action, motion: Motion) -> Outcome:
    pair = action.get("tracks")
    if not isinstance(pair, list | tuple) or len(pair) != 2 or pair[0] == pair[1]:
        raise InputError("merging requires two different tracks; select another track")
    first, second = (require_track(state, track_id) for track_id in pair)
    boxes = {**second.boxes, **first.boxes}
    boxes |= {f: b for f, b in second.boxes.items() if b.kind == KEY and boxes[f].kind != KEY}
    removed_frames = (first.removed_frames | second.removed_frames) - boxes.keys()
    merged_track = replace(
        first,
        boxes=boxes,
        removed_frames=removed_frames,
        extra={**second.extra, **first.extra},
        is_edited=True,
        is_partly_tracked=False,
    )
    seeds = tuple(dict.fromkeys((f, first.id if t == second.id else t) for f, t in state.seeds))
    return {first.id: merged_track, second.id: None}, seeds, state.checked_frames


def _split_track(state: State, action: Action, motion: Motion) -> Outcome:
    track, frame = require_track(state, action.get("track")), require_frame(action, motion)
    earlier_frames, later_frames = ({f for f in track.boxes if (f >= frame) == is_after} for is_after in (False, True))
    if not earlier_frames or not later_frames:
        raise InputError(
            f"track {track.id} cannot be split at frame {frame}: it needs boxes both before and from this frame on"
        )

    def make_part(frames: set[int], track_id: int, is_after: bool) -> Track:
        return replace(
            track,
            id=track_id,
            boxes={f: track.boxes[f] for f in sorted(frames)},
            removed_frames=frozenset(f for f in track.removed_frames if (f >= frame) == is_after),
            extra={f: v for f, v in track.extra.items() if (f >= frame) == is_after},
            is_edited=True,
            is_partly_tracked=False,
        )

    new_id = state.next_id
    seeds = tuple((f, new_id if t == track.id and f >= frame else t) for f, t in state.seeds)
    return (
        {track.id: make_part(earlier_frames, track.id, False), new_id: make_part(later_frames, new_id, True)},
        seeds,
        state.checked_frames,
    )


def _trim_track(state: State, action: Action, motion: Motion) -> Outcome:
    track, frame = require_track(state, action.get("track")), require_frame(action, motion)
    side = action.get("side")
    if side not in ("before", "after"):
        raise InputError("side must be 'before' or 'after'")
    trimmed_frames = {f for f in range(len(motion.times)) if (f < frame if side == "before" else f > frame)}
    frames_with_box = trimmed_frames & track.boxes.keys()
    boxes = {f: b for f, b in track.boxes.items() if f not in frames_with_box}
    if not frames_with_box:
        raise InputError(f"track {track.id} has no boxes {side} frame {frame}")
    if not boxes:
        raise InputError(f"all boxes of track {track.id} are {side} frame {frame}; reject the track instead")
    seeds = tuple(s for s in state.seeds if s[1] != track.id or s[0] not in frames_with_box)
    # A partly tracked object has no boxes yet in some frames that tracking would add later.
    removed_frames = track.removed_frames | (trimmed_frames if track.is_partly_tracked else frames_with_box)
    return {track.id: replace(track, boxes=boxes, removed_frames=removed_frames)}, seeds, state.checked_frames


def _set_checked(state: State, action: Action, motion: Motion) -> Outcome:
    frame, is_checked = require_frame(action, motion), action.get("checked", True)
    if not isinstance(is_checked, bool):
        raise InputError("checked must be true or false")
    return {}, state.seeds, state.checked_frames | {frame} if is_checked else state.checked_frames - {frame}


HANDLERS: dict[str, Callable[[State, Action, Motion], Outcome]] = {
    "seed": _add_seed_track,
    "add": _add_track,
    "box": _set_box,
    "size": _set_size,
    "remove_box": _remove_box,
    "interpolate": _interpolate_track,
    "copy": _copy_box,
    "class": _set_class,
    "accept": _accept_track,
    "reject": _reject_track,
    "reject_rest": _reject_rest,
    "reopen": _reopen_track,
    "merge": _merge_tracks,
    "split": _split_track,
    "trim": _trim_track,
    "check": _set_checked,
    "snap": _set_box,
    "propose": _replace_with_computed,
    "import": _replace_with_computed,
}


def round_box(values: np.ndarray[Any, Any]) -> list[float]:
    """Round a computed box to 0.1 mm (and 0.1 mrad), to keep the journal short."""
    return [round(v, 4) for v in np.asarray(values, np.float64).tolist()]


def strip_computed(action: Mapping[str, Any]) -> Action:
    """Remove the fields that only the session may set. Raises InputError if a page sends poses."""
    if action.get("do") == "poses":
        raise InputError("a page cannot set poses; they come from the recording or from scan matching")
    computed_fields = {
        "seed": ("track", "tracks", "removed"),
        "propose": ("tracks", "removed"),
        "import": ("tracks", "removed", "kept"),
        "accept": ("seed",),
        "reopen": ("seed",),
        "snap": ("box",),
    }
    removed_fields = ("seq", "time", "by", "joins", "beside", *computed_fields.get(str(action.get("do")), ()))
    return {k: v for k, v in action.items() if k not in removed_fields}
