"""The labels of a drive as they are being made: tracks of boxes, and what has been done to them.

A State never changes; actions.py makes the next one of it. Boxes are in the LiDAR frame of their
own scan.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

KEY, PROPOSED, INTERPOLATED = "key", "proposed", "interpolated"  # kinds of boxes
ACCEPTED, REJECTED = "accepted", "rejected"                      # of tracks, beside PROPOSED
CLICK = "click"  # source of a track that a person clicked, to be followed through the drive


class Box(NamedTuple):
    """[x y z l w h yaw] and where it comes from: KEY, from a person; PROPOSED; INTERPOLATED,
    between key boxes."""

    values: tuple[float, ...]
    kind: str

    @staticmethod
    def of(values: np.ndarray[Any, Any], kind: str) -> Box:
        """The box of an array (7,) float64."""
        return Box(tuple(values.tolist()), kind)


@dataclass(frozen=True)
class Track:
    """One object through the drive. boxes by frame; gone: frames where a person removed its box;
    extra: by frame, what an imported label says besides, to be exported again; edited: a person
    gave it its class, or cut or joined it; nearby: it was clicked, and is followed only through the
    frames around that yet."""

    id: int
    class_name: str
    state: str = PROPOSED
    score: float = 1.0
    source: str = CLICK
    boxes: Mapping[int, Box] = field(default_factory=dict)
    gone: frozenset[int] = frozenset()
    extra: Mapping[int, Any] = field(default_factory=dict)
    edited: bool = False
    nearby: bool = False

    @property
    def touched(self) -> bool:
        """Whether a person has had a hand in it."""
        return (self.state != PROPOSED or self.edited or bool(self.gone)
                or any(box.kind == KEY for box in self.boxes.values()))

    @property
    def placed(self) -> bool:
        """Whether a person clicked it, and it waits to be followed through the drive."""
        return (self.source == CLICK and self.state != REJECTED and not self.edited
                and (len(self.boxes) == 1 or self.nearby))

    @property
    def uncertainty(self) -> float:
        """0..1: how near the score is to the threshold, a half."""
        return 1.0 - 2.0 * abs(self.score - 0.5)

    def nearest_frame(self) -> int:
        """The frame in which it is nearest to the sensor."""
        return min(self.boxes, key=lambda f: (math.hypot(*self.boxes[f].values[:2]), f), default=0)


class Change(NamedTuple):
    """What one action changed, before and after: tracks by id (None: not there), seeds, checked
    frames, what imported files said besides."""

    tracks: Mapping[int, tuple[Track | None, Track | None]]
    seeds: tuple[Seeds, Seeds]
    checked: tuple[frozenset[int], frozenset[int]]
    kept: tuple[Kept, Kept]

    def then(self, later: Change) -> Change:
        """This change and one after it, as one."""
        tracks = {n: (self.tracks[n] if n in self.tracks else later.tracks[n])[:1]
                  + (later.tracks[n] if n in later.tracks else self.tracks[n])[1:]
                  for n in (*self.tracks, *later.tracks)}
        return Change(tracks, (self.seeds[0], later.seeds[1]),
                      (self.checked[0], later.checked[1]), (self.kept[0], later.kept[1]))

    def turned_round(self) -> Change:
        """The change that takes it back."""
        return Change({k: (after, before) for k, (before, after) in self.tracks.items()},
                      self.seeds[::-1], self.checked[::-1], self.kept[::-1])


Seeds = tuple[tuple[int, int], ...]    # (frame, track id)
Kept = Mapping[str, Any]               # "notes" by frame, "extra": see labelled.py
Stack = tuple[Change, Any] | None      # a change, and the stack below it: shared between states


@dataclass(frozen=True)
class State:
    """seq: number of the last action; next_id: no track ever had it; done and undone: what can be
    undone and redone; poses: (F, 16) of the sensor by the scans, where the drive has none."""

    tracks: Mapping[int, Track] = field(default_factory=dict)
    seeds: Seeds = ()
    checked: frozenset[int] = frozenset()
    seq: int = 0
    next_id: int = 1
    kept: Kept = field(default_factory=dict)
    poses: tuple[tuple[float, ...], ...] = ()
    done: Stack = None
    undone: Stack = None

    def after(self, change: Change) -> State:
        """With the change made; the stacks stay."""
        tracks = dict(self.tracks)
        for number, (_, track) in change.tracks.items():
            if track is None:
                tracks.pop(number, None)
            else:
                tracks[number] = track
        return replace(self, tracks=tracks, seeds=change.seeds[1], checked=change.checked[1],
                       kept=change.kept[1],
                       next_id=max(self.next_id, *(n + 1 for n in change.tracks), 1))


def track_to_json(track: Track) -> dict[str, Any]:
    """As the page and the journal have it."""
    found = {"id": track.id, "class": track.class_name, "state": track.state,
             "score": track.score, "source": track.source,
             "boxes": [[f, *b.values, b.kind] for f, b in sorted(track.boxes.items())],
             "uncertainty": track.uncertainty}
    if track.gone:
        found["gone"] = sorted(track.gone)
    if track.extra:
        found["extra"] = {str(f): track.extra[f] for f in sorted(track.extra)}
    return found | {name: True for name in ("edited", "nearby") if getattr(track, name)}


def track_from_json(found: Mapping[str, Any]) -> Track:
    """The inverse of track_to_json."""
    boxes = {int(f): Box(tuple(map(float, values)), kind)
             for f, *values, kind in found["boxes"]}
    return Track(int(found["id"]), str(found["class"]), found["state"], float(found["score"]),
                 str(found["source"]), boxes, frozenset(found.get("gone", ())),
                 {int(f): v for f, v in found.get("extra", {}).items()},
                 found.get("edited", False), found.get("nearby", False))


def next_uncertain(state: State, after: int | None = None,
                   among: Callable[[Track], bool] = lambda track: True) -> Track | None:
    """The proposed track, of some, whose score is nearest to the threshold, or, given one of these,
    the next; after the last the first again. Ties by id."""
    waiting = sorted((t for t in state.tracks.values() if t.state == PROPOSED and among(t)),
                     key=lambda t: (-t.uncertainty, t.id))
    if not waiting:
        return None
    place = next((i for i, t in enumerate(waiting) if t.id == after), -1)
    return waiting[(place + 1) % len(waiting)]


def progress(state: State, frames: int) -> dict[str, int]:
    """How far the work is."""
    states = [t.state for t in state.tracks.values()]
    accepted, rejected = states.count(ACCEPTED), states.count(REJECTED)
    return {"tracks": len(states), "accepted": accepted, "rejected": rejected,
            "left": len(states) - accepted - rejected, "frames": frames,
            "checked": len(state.checked), "actions": state.seq}
