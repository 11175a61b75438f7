"""Immutable state of a labelling session: tracks of boxes, seeds, checked frames, undo history.

Boxes are in the LiDAR frame of their scan. actions.py computes the next state.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

KEY, PROPOSED, INTERPOLATED = "key", "proposed", "interpolated"  # kinds of boxes
ACCEPTED, REJECTED = "accepted", "rejected"  # states of tracks, in addition to PROPOSED
CLICK = "click"  # source of a clicked track, which is then tracked through the drive


class Box(NamedTuple):
    """[x y z l w h yaw]; KEY (set by a person), PROPOSED or INTERPOLATED (between key boxes)."""

    values: tuple[float, ...]
    kind: str

    @staticmethod
    def of(values: np.ndarray[Any, Any], kind: str) -> Box:
        """Make a box from an array (7,) float64."""
        return Box(tuple(values.tolist()), kind)


@dataclass(frozen=True)
class Track:
    """One object over the frames of a drive.

    boxes: by frame.
    removed_frames: frames from which a person removed the box.
    extra: by frame, fields of an imported label that are preserved for export.
    edited: a person changed the class, or split or merged the track.
    nearby: a clicked track that so far has boxes only in the frames around the click.
    """

    id: int
    class_name: str
    state: str = PROPOSED
    score: float = 1.0
    source: str = CLICK
    boxes: Mapping[int, Box] = field(default_factory=dict)
    removed_frames: frozenset[int] = frozenset()
    extra: Mapping[int, Any] = field(default_factory=dict)
    edited: bool = False
    nearby: bool = False

    @property
    def has_human_edits(self) -> bool:
        """True if a person accepted, rejected or changed the track."""
        return (
            self.state != PROPOSED
            or self.edited
            or bool(self.removed_frames)
            or any(box.kind == KEY for box in self.boxes.values())
        )

    @property
    def awaits_tracking(self) -> bool:
        """True for a clicked track that is not yet tracked through the whole drive."""
        return (
            self.source == CLICK
            and self.state != REJECTED
            and not self.edited
            and (len(self.boxes) == 1 or self.nearby)
        )

    @property
    def uncertainty(self) -> float:
        """Uncertainty of the score: 1 at 0.5, falling to 0 at 0 and 1."""
        return 1.0 - 2.0 * abs(self.score - 0.5)

    def find_nearest_frame(self) -> int:
        """Return the frame in which the object is nearest to the sensor; 0 without boxes."""
        return min(self.boxes, key=lambda f: (math.hypot(*self.boxes[f].values[:2]), f), default=0)


class Change(NamedTuple):
    """Values before and after an action: tracks by id (None if absent), seeds, checked frames, and
    the preserved fields of imported files."""

    tracks: Mapping[int, tuple[Track | None, Track | None]]
    seeds: tuple[Seeds, Seeds]
    checked: tuple[frozenset[int], frozenset[int]]
    preserved: tuple[PreservedFields, PreservedFields]

    def combine_with(self, later: Change) -> Change:
        """Return this change and a later one as a single change."""
        tracks = {
            n: (self.tracks[n] if n in self.tracks else later.tracks[n])[:1]
            + (later.tracks[n] if n in later.tracks else self.tracks[n])[1:]
            for n in (*self.tracks, *later.tracks)
        }
        return Change(
            tracks,
            (self.seeds[0], later.seeds[1]),
            (self.checked[0], later.checked[1]),
            (self.preserved[0], later.preserved[1]),
        )

    def invert(self) -> Change:
        """Return the change that undoes this one."""
        return Change(
            {k: (after, before) for k, (before, after) in self.tracks.items()},
            self.seeds[::-1],
            self.checked[::-1],
            self.preserved[::-1],
        )


Seeds = tuple[tuple[int, int], ...]  # (frame, track id)
PreservedFields = Mapping[str, Any]  # preserved fields of imported files, see label_conversion.py
Stack = tuple[Change, Any] | None  # a change, and the stack below it: shared between states


@dataclass(frozen=True)
class State:
    """The labels after an action.

    seq: number of that action.
    next_id: id of the next new track.
    preserved: preserved fields of imported files.
    poses: (F, 16) sensor poses from scan matching, if the recording has none.
    """

    tracks: Mapping[int, Track] = field(default_factory=dict)
    seeds: Seeds = ()
    checked: frozenset[int] = frozenset()
    seq: int = 0
    next_id: int = 1
    preserved: PreservedFields = field(default_factory=dict)
    poses: tuple[tuple[float, ...], ...] = ()
    undo_stack: Stack = None
    redo_stack: Stack = None

    def with_change(self, change: Change) -> State:
        """Return the state after a change, with the same undo and redo stacks."""
        tracks = dict(self.tracks)
        for number, (_, track) in change.tracks.items():
            if track is None:
                tracks.pop(number, None)
            else:
                tracks[number] = track
        return replace(
            self,
            tracks=tracks,
            seeds=change.seeds[1],
            checked=change.checked[1],
            preserved=change.preserved[1],
            next_id=max(self.next_id, *(n + 1 for n in change.tracks), 1),
        )


def track_to_json(track: Track) -> dict[str, Any]:
    """Convert a track to the JSON object of the page and the journal."""
    content = {
        "id": track.id,
        "class": track.class_name,
        "state": track.state,
        "score": track.score,
        "source": track.source,
        "boxes": [[f, *b.values, b.kind] for f, b in sorted(track.boxes.items())],
        "uncertainty": track.uncertainty,
    }
    if track.removed_frames:
        content["gone"] = sorted(track.removed_frames)
    if track.extra:
        content["extra"] = {str(f): track.extra[f] for f in sorted(track.extra)}
    return content | {name: True for name in ("edited", "nearby") if getattr(track, name)}


def track_from_json(content: Mapping[str, Any]) -> Track:
    """Make a track from the object of track_to_json."""
    boxes = {int(f): Box(tuple(map(float, values)), kind) for f, *values, kind in content["boxes"]}
    return Track(
        int(content["id"]),
        str(content["class"]),
        content["state"],
        float(content["score"]),
        str(content["source"]),
        boxes,
        frozenset(content.get("gone", ())),
        {int(f): v for f, v in content.get("extra", {}).items()},
        content.get("edited", False),
        content.get("nearby", False),
    )


def find_next_uncertain(
    state: State, after: int | None = None, condition: Callable[[Track], bool] = lambda track: True
) -> Track | None:
    """Return the most uncertain proposed track that meets a condition, or None.

    after: id of a track; the next one in this order is returned, or the first one after the last.
    """
    candidates = sorted(
        (t for t in state.tracks.values() if t.state == PROPOSED and condition(t)), key=lambda t: (-t.uncertainty, t.id)
    )
    if not candidates:
        return None
    index = next((i for i, t in enumerate(candidates) if t.id == after), -1)
    return candidates[(index + 1) % len(candidates)]


def count_progress(state: State, frames: int) -> dict[str, int]:
    """Count tracks by state, checked frames and actions, for the page."""
    states = [t.state for t in state.tracks.values()]
    accepted, rejected = states.count(ACCEPTED), states.count(REJECTED)
    return {
        "tracks": len(states),
        "accepted": accepted,
        "rejected": rejected,
        "left": len(states) - accepted - rejected,
        "frames": frames,
        "checked": len(state.checked),
        "actions": state.seq,
    }
