"""Immutable state of a labelling session: tracks, seeds, checked frames and undo history.

Boxes are in the LiDAR frame of their scan. actions.py computes the next state.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

KEY, PROPOSED, INTERPOLATED = "key", "proposed", "interpolated"  # box kinds
ACCEPTED, REJECTED = "accepted", "rejected"  # track states, in addition to PROPOSED
CLICK = "click"  # track source: a person clicked the object, which is then tracked through the drive


class Box(NamedTuple):
    """A box [x y z l w h yaw] and its kind: KEY (set by a person), PROPOSED or INTERPOLATED."""

    values: tuple[float, ...]
    kind: str

    @staticmethod
    def from_array(values: np.ndarray[Any, Any], kind: str) -> Box:
        """Make a box from an array (7,) float64."""
        return Box(tuple(values.tolist()), kind)


@dataclass(frozen=True)
class Track:
    """An object and its boxes in the frames of a drive.

    Attributes:
        boxes: Box of each frame in which the object has one.
        removed_frames: Frames from which a person removed the box.
        extra: Fields of an imported label to preserve for export, by frame.
        is_edited: True if a person changed the class, or split or merged the track.
        is_partly_tracked: True if a clicked object has only been tracked in the frames around the click.
    """

    id: int
    class_name: str
    state: str = PROPOSED
    score: float = 1.0
    source: str = CLICK
    boxes: Mapping[int, Box] = field(default_factory=dict)
    removed_frames: frozenset[int] = frozenset()
    extra: Mapping[int, Any] = field(default_factory=dict)
    is_edited: bool = False
    is_partly_tracked: bool = False

    @property
    def has_human_edits(self) -> bool:
        """True if a person accepted, rejected or changed the track."""
        return (
            self.state != PROPOSED
            or self.is_edited
            or bool(self.removed_frames)
            or any(box.kind == KEY for box in self.boxes.values())
        )

    @property
    def awaits_tracking(self) -> bool:
        """True for a clicked track that is not yet tracked through the whole drive."""
        return (
            self.source == CLICK
            and self.state != REJECTED
            and not self.is_edited
            and (len(self.boxes) == 1 or self.is_partly_tracked)
        )

    @property
    def uncertainty(self) -> float:
        """Uncertainty of the score: 1 at a score of 0.5, falling linearly to 0 at scores of 0 and 1."""
        return 1.0 - 2.0 * abs(self.score - 0.5)

    def find_nearest_frame(self) -> int:
        """Return the frame in which the object is nearest to the sensor, or 0 if the track has no boxes."""
        return min(self.boxes, key=lambda f: (math.hypot(*self.boxes[f].values[:2]), f), default=0)


class Change(NamedTuple):
    """Changes made by an action, as pairs of the values before and after it.

    A track is None where it does not exist.
    """

    tracks: Mapping[int, tuple[Track | None, Track | None]]
    seeds: tuple[Seeds, Seeds]
    checked_frames: tuple[frozenset[int], frozenset[int]]
    preserved_fields: tuple[PreservedFields, PreservedFields]

    def combine_with(self, later: Change) -> Change:
        """Return a single change with the effect of this change followed by `later`."""
        tracks = {
            n: (self.tracks[n] if n in self.tracks else later.tracks[n])[:1]
            + (later.tracks[n] if n in later.tracks else self.tracks[n])[1:]
            for n in (*self.tracks, *later.tracks)
        }
        return Change(
            tracks,
            (self.seeds[0], later.seeds[1]),
            (self.checked_frames[0], later.checked_frames[1]),
            (self.preserved_fields[0], later.preserved_fields[1]),
        )

    def invert(self) -> Change:
        """Return the change that undoes this one."""
        return Change(
            {k: (after, before) for k, (before, after) in self.tracks.items()},
            self.seeds[::-1],
            self.checked_frames[::-1],
            self.preserved_fields[::-1],
        )


Seeds = tuple[tuple[int, int], ...]  # (frame, track id)
PreservedFields = Mapping[str, Any]  # fields of imported files to preserve for export, see label_conversion.py
Stack = tuple[Change, Any] | None  # linked list: a change and the stack below it, shared between states


@dataclass(frozen=True)
class State:
    """Labels after an action.

    Attributes:
        seq: Number of the action.
        next_id: Id for the next new track.
        poses: (F, 16) sensor poses from scan matching; empty if the recording has poses.
    """

    tracks: Mapping[int, Track] = field(default_factory=dict)
    seeds: Seeds = ()
    checked_frames: frozenset[int] = frozenset()
    seq: int = 0
    next_id: int = 1
    preserved_fields: PreservedFields = field(default_factory=dict)
    poses: tuple[tuple[float, ...], ...] = ()
    undo_stack: Stack = None
    redo_stack: Stack = None

    def with_change(self, change: Change) -> State:
        """Return the state after a change, with unchanged undo and redo stacks."""
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
            checked_frames=change.checked_frames[1],
            preserved_fields=change.preserved_fields[1],
            next_id=max(self.next_id, *(n + 1 for n in change.tracks), 1),
        )


def track_to_json(track: Track) -> dict[str, Any]:
    """Convert a track to the JSON object used by the page and the journal."""
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
    flags = {"edited": track.is_edited, "nearby": track.is_partly_tracked}
    return content | {name: True for name, is_set in flags.items() if is_set}


def track_from_json(content: Mapping[str, Any]) -> Track:
    """Make a track from a JSON object made by track_to_json()."""
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
    """Return the next proposed track that meets a condition, most uncertain first, or None.

    Args:
        after: Id of the current track. The search continues behind it and wraps around.
    """
    candidates = sorted(
        (t for t in state.tracks.values() if t.state == PROPOSED and condition(t)), key=lambda t: (-t.uncertainty, t.id)
    )
    if not candidates:
        return None
    index = next((i for i, t in enumerate(candidates) if t.id == after), -1)
    return candidates[(index + 1) % len(candidates)]


def count_progress(state: State, frames: int) -> dict[str, int]:
    """Count the tracks by state, the checked frames and the actions."""
    states = [t.state for t in state.tracks.values()]
    accepted_count, rejected_count = states.count(ACCEPTED), states.count(REJECTED)
    return {
        "tracks": len(states),
        "accepted": accepted_count,
        "rejected": rejected_count,
        "left": len(states) - accepted_count - rejected_count,
        "frames": frames,
        "checked": len(state.checked_frames),
        "actions": state.seq,
    }
