"""What a person can do to the labels: apply(state, action) is the next state, and nothing else.

Actions are dicts as they stand in the journal, with what was computed for them: replaying the lines
gives the same state, and needs no detector.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from lidar_perception.types import MAX_RANGE, InputError
from lidar_studio.interpolation import Motion, corrected, straightened
from lidar_studio.state import (
    ACCEPTED,
    KEY,
    PROPOSED,
    REJECTED,
    Box,
    Change,
    Seeds,
    Stack,
    State,
    Track,
    track_from_json,
)

Action = Mapping[str, Any]
Tracks = dict[int, Track | None]  # what an action makes of tracks; None: away
MAX_NAME = 100                    # characters of a class


def apply(state: State, action: Action, motion: Motion) -> tuple[State, Change]:
    """The next state, and what changed. InputError, in one line for a person, for an action that
    cannot be done; the state stays as it was."""
    name, motion = action.get("do"), motion_of(state, motion)
    if name == "poses":  # knowledge, not an edit: it is not undone
        poses = tuple(tuple(map(float, row)) for row in action["poses"])
        return replace(state, poses=poses, seq=state.seq + 1), Change(
            {}, (state.seeds, state.seeds), (state.checked, state.checked),
            (state.kept, state.kept))
    if name == "undo" or name == "redo":
        return _back(state) if name == "undo" else _forth(state)
    if name not in DO:
        raise InputError(f"unknown action {str(name)[:40]!r}; known are "
                         f"{', '.join((*DO, 'undo', 'redo'))}")
    tracks, seeds, checked = DO[name](state, action, motion)
    change = Change({n: (state.tracks.get(n), track) for n, track in tracks.items()
                     if state.tracks.get(n) != track},
                    (state.seeds, seeds), (state.checked, checked),
                    (state.kept, action.get("kept", state.kept) if name == "import"
                     else state.kept))
    done: Stack = (change, state.done)
    undone: Stack = None
    if action.get("joins") and state.done is not None:  # the rest of what the last action began
        done = state.done[0].then(change), state.done[1]
    elif action.get("beside"):  # nobody did it: what people did stays what can be undone
        done, undone = state.done, state.undone
    return replace(state.after(change), seq=state.seq + 1, done=done, undone=undone), change


def motion_of(state: State, motion: Motion) -> Motion:
    """The drive's own, or with the poses that were found by the scans."""
    if motion.poses is not None or len(state.poses) != len(motion.times):
        return motion
    return Motion(motion.times, np.array(state.poses, np.float64).reshape(-1, 4, 4))


def _back(state: State) -> tuple[State, Change]:
    if state.done is None:
        raise InputError("there is nothing to undo")
    change, below = state.done
    back = change.turned_round()
    return replace(state.after(back), seq=state.seq + 1, done=below,
                   undone=(change, state.undone)), back


def _forth(state: State) -> tuple[State, Change]:
    if state.undone is None:
        raise InputError("there is nothing to redo")
    change, below = state.undone
    return replace(state.after(change), seq=state.seq + 1, done=(change, state.done),
                   undone=below), change


Made = tuple[Tracks, Seeds, frozenset[int]]


def _only(state: State, *tracks: Track) -> Made:
    return {track.id: track for track in tracks}, state.seeds, state.checked


def frame_of(action: Action, motion: Motion, name: str = "frame") -> int:
    """A frame that an action names. InputError where the drive has none of this number."""
    frame, frames = action.get(name), len(motion.times)
    if not isinstance(frame, int) or isinstance(frame, bool) or not 0 <= frame < frames:
        raise InputError(f"there is no frame {str(frame)[:40]}; the drive has 0 .. {frames - 1}")
    return frame


def track_of(state: State, number: Any) -> Track:
    """The track of a number. InputError where there is none."""
    if not isinstance(number, int) or isinstance(number, bool) or number not in state.tracks:
        raise InputError(f"there is no track {str(number)[:40]}; reload the page")
    return state.tracks[number]


def box_of(track: Track, frame: int) -> Box:
    """The box of a track in a frame. InputError where it has none."""
    if frame not in track.boxes:
        raise InputError(f"track {track.id} has no box in frame {frame}; copy one there first")
    return track.boxes[frame]


def numbers(action: Action, name: str, count: int) -> tuple[float, ...]:
    """So many finite numbers of an action. InputError where they are not."""
    values = action.get(name)
    if not isinstance(values, list | tuple) or len(values) != count or not all(
            isinstance(v, int | float) and not isinstance(v, bool) and abs(v) <= MAX_RANGE
            for v in values):
        raise InputError(f"{name} must be {count} finite numbers within {MAX_RANGE:g}, not "
                         f"{str(values)[:80]}")
    return tuple(map(float, values))


def sizes(values: tuple[float, ...]) -> tuple[float, ...]:
    """Length, width and height themselves. InputError where one is not above 0."""
    if min(values) <= 0:
        raise InputError(f"length, width and height must be above 0, not {list(values)}")
    return values


def whole_box(action: Action) -> tuple[float, ...]:
    """The box of an action. InputError where it is none."""
    values = numbers(action, "box", 7)
    sizes(values[3:6])
    return values


def class_of(action: Action) -> str:
    """The class that an action names; any text is one. InputError for what is no name."""
    name = action.get("class")
    if not isinstance(name, str) or not name.strip() or len(name) > MAX_NAME:
        raise InputError(f"a class is a name of up to {MAX_NAME} characters, not "
                         f"{str(name)[:40]!r}")
    return name


def _given(state: State, action: Action) -> Tracks:
    """The tracks that were computed for an action."""
    found: Tracks = {int(n): None for n in action.get("removed", ())}
    found |= {t.id: t for t in map(track_from_json, action.get("tracks", ()))}
    return found


def _results(state: State, action: Action, motion: Motion) -> Made:
    return _given(state, action), state.seeds, state.checked


def _seed(state: State, action: Action, motion: Motion) -> Made:
    frame, own = frame_of(action, motion), action.get("track")
    if not isinstance(own, int):
        raise InputError("a seed needs its track; the server finds it")
    return _given(state, action), _with_seed(state.seeds, frame, own), state.checked


def _with_seed(seeds: Seeds, frame: int, track: int) -> Seeds:
    return seeds if (frame, track) in seeds else (*seeds, (frame, track))


def _add(state: State, action: Action, motion: Motion) -> Made:
    frame, box = frame_of(action, motion), Box(whole_box(action), KEY)
    return _only(state, Track(state.next_id, class_of(action), ACCEPTED, 1.0, "person",
                              {frame: box}))


def _box(state: State, action: Action, motion: Motion) -> Made:
    track, frame = track_of(state, action.get("track")), frame_of(action, motion)
    gone = track.gone - {frame}
    boxes = corrected(track.boxes, gone, frame, whole_box(action), motion)
    return _only(state, replace(track, boxes=boxes, gone=gone))


def _size(state: State, action: Action, motion: Motion) -> Made:
    track = track_of(state, action.get("track"))
    size = sizes(numbers(action, "size", 3))
    boxes = {}
    for frame, box in track.boxes.items():
        x, y, z, _, _, height, yaw = box.values
        boxes[frame] = Box((x, y, z + (size[2] - height) / 2, *size, yaw), box.kind)
    return _only(state, replace(track, boxes=boxes))


def _remove_box(state: State, action: Action, motion: Motion) -> Made:
    track, frame = track_of(state, action.get("track")), frame_of(action, motion)
    box_of(track, frame)
    boxes = {f: b for f, b in track.boxes.items() if f != frame}
    if not boxes:
        return {track.id: None}, _without(state.seeds, track.id), state.checked
    return _only(state, replace(track, boxes=boxes, gone=track.gone | {frame}))


def _interpolate(state: State, action: Action, motion: Motion) -> Made:
    track, frame = track_of(state, action.get("track")), frame_of(action, motion)
    gone = track.gone - {frame}
    boxes = straightened(track.boxes, gone, frame, motion)
    if boxes is None:
        raise InputError(f"track {track.id} has no key box on both sides of frame {frame}")
    return _only(state, replace(track, boxes=boxes, gone=gone))


def _without(seeds: Seeds, track: int) -> Seeds:
    return tuple(seed for seed in seeds if seed[1] != track)


def _copy(state: State, action: Action, motion: Motion) -> Made:
    track = track_of(state, action.get("track"))
    frm, to = frame_of(action, motion, "from"), frame_of(action, motion, "to")
    box = motion.carried(box_of(track, frm).values, frm, to)
    return _box(state, {"track": track.id, "frame": to, "box": box.tolist()}, motion)


def _class(state: State, action: Action, motion: Motion) -> Made:
    track = track_of(state, action.get("track"))
    return _only(state, replace(track, class_name=class_of(action),
                                edited=track.edited or track.state == PROPOSED))


def _reject_rest(state: State, action: Action, motion: Motion) -> Made:
    only = class_of(action) if "class" in action else None
    left = [t for t in state.tracks.values() if t.state == PROPOSED
            and only in (None, t.class_name)]
    if not left:
        raise InputError(f"no track{f' of class {only}' if only else ''} is left to reject")
    return _only(state, *(replace(t, state=REJECTED) for t in left))


def _accept(state: State, action: Action, motion: Motion, to: str = ACCEPTED) -> Made:
    track, seeds = track_of(state, action.get("track")), state.seeds
    if action.get("seed") is not None:  # the frame in which it is the best one
        seeds = _with_seed(seeds, frame_of(action, motion, "seed"), track.id)
    return {track.id: replace(track, state=to)}, seeds, state.checked


def _reject(state: State, action: Action, motion: Motion) -> Made:
    track = track_of(state, action.get("track"))
    seeds = _without(state.seeds, track.id)
    return {track.id: replace(track, state=REJECTED)}, seeds, state.checked


def _reopen(state: State, action: Action, motion: Motion) -> Made:
    return _accept(state, action, motion, PROPOSED)


def _merge(state: State, action: Action, motion: Motion) -> Made:
    both = action.get("tracks")
    if not isinstance(both, list | tuple) or len(both) != 2 or both[0] == both[1]:
        raise InputError("two different tracks are merged; select a second one")
    first, second = (track_of(state, number) for number in both)
    boxes = {**second.boxes, **first.boxes}
    boxes |= {f: b for f, b in second.boxes.items()
              if b.kind == KEY and boxes[f].kind != KEY}
    gone = (first.gone | second.gone) - boxes.keys()
    merged = replace(first, boxes=boxes, gone=gone, extra={**second.extra, **first.extra},
                     edited=True, nearby=False)
    seeds = tuple(dict.fromkeys((f, first.id if t == second.id else t) for f, t in state.seeds))
    return {first.id: merged, second.id: None}, seeds, state.checked


def _split(state: State, action: Action, motion: Motion) -> Made:
    track, frame = track_of(state, action.get("track")), frame_of(action, motion)
    early, late = ({f for f in track.boxes if (f >= frame) == after} for after in (False, True))
    if not early or not late:
        raise InputError(f"track {track.id} has boxes on one side of frame {frame} only; split it "
                         "between its first and its last")

    def part(frames: set[int], number: int, after: bool) -> Track:
        return replace(track, id=number, boxes={f: track.boxes[f] for f in sorted(frames)},
                       gone=frozenset(f for f in track.gone if (f >= frame) == after),
                       extra={f: v for f, v in track.extra.items() if (f >= frame) == after},
                       edited=True, nearby=False)
    new = state.next_id
    seeds = tuple((f, new if t == track.id and f >= frame else t) for f, t in state.seeds)
    return ({track.id: part(early, track.id, False), new: part(late, new, True)}, seeds,
            state.checked)


def _trim(state: State, action: Action, motion: Motion) -> Made:
    track, frame = track_of(state, action.get("track")), frame_of(action, motion)
    side = action.get("side")
    if side not in ("before", "after"):
        raise InputError("a track is trimmed before or after a frame")
    beyond = {f for f in range(len(motion.times))
              if (f < frame if side == "before" else f > frame)}
    cut = beyond & track.boxes.keys()
    kept = {f: b for f, b in track.boxes.items() if f not in cut}
    if not cut or not kept:
        raise InputError(f"track {track.id} has {'no' if kept else 'only'} boxes {side} frame "
                         f"{frame}")
    seeds = tuple(s for s in state.seeds if s[1] != track.id or s[0] not in cut)
    gone = track.gone | (beyond if track.nearby else cut)  # it may be followed there yet
    return ({track.id: replace(track, boxes=kept, gone=gone)}, seeds, state.checked)


def _check(state: State, action: Action, motion: Motion) -> Made:
    frame, checked = frame_of(action, motion), action.get("checked", True)
    if not isinstance(checked, bool):
        raise InputError("checked must be true or false")
    return {}, state.seeds, state.checked | {frame} if checked else state.checked - {frame}


DO: dict[str, Callable[[State, Action, Motion], Made]] = {
    "seed": _seed, "add": _add, "box": _box, "size": _size, "remove_box": _remove_box,
    "interpolate": _interpolate, "copy": _copy, "class": _class, "accept": _accept,
    "reject": _reject, "reject_rest": _reject_rest, "reopen": _reopen, "merge": _merge,
    "split": _split, "trim": _trim, "check": _check, "snap": _box, "propose": _results,
    "import": _results,
}


def rounded(values: np.ndarray[Any, Any]) -> list[float]:
    """Of a computed box: to a tenth of a millimetre, which is all a journal need hold."""
    return [round(v, 4) for v in np.asarray(values, np.float64).tolist()]
