"""Tracks to the labels of a drive and back, as the formats read and write them.

What a file says that tracks have no place for stays with them: of a box in Track.extra, by frame;
of frames and of the drive in State.kept.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from typing import Any

from lidar_perception.data.frame import Frame
from lidar_perception.labels.drive_labels import NO_TRACK, DriveLabels, FrameLabels
from lidar_perception.labels.formats.files import replace_non_finite
from lidar_studio.state import ACCEPTED, KEY, Box, Kept, State, Track, track_to_json

IMPORTED = "imported"  # source of a track
ID, SCORE, REST = "track_id", "score", "rest"  # of Track.extra


def from_labels(labels: DriveLabels, first_id: int) -> tuple[list[Track], dict[str, Any]]:
    """Accepted tracks of key boxes, numbered from first_id; and what State.kept is to hold. Boxes
    of one track id and one class are a track; a box without an id is one of its own."""
    found: dict[tuple[Any, ...], tuple[str, dict[int, Box], dict[int, dict[str, Any]]]] = {}
    for f, frame in enumerate(labels.frames):
        for k, name in enumerate(frame.class_names):
            number, score = int(frame.track_ids[k]), float(frame.scores[k])
            said = {ID: number, REST: replace_non_finite(frame.extra[k]),
                    **({} if math.isnan(score) else {SCORE: score})}
            key = (number, name) if number != NO_TRACK else (NO_TRACK, f, k)
            if key in found and f in found[key][1]:  # an id twice in a frame: two tracks
                key = NO_TRACK, f, k
            _, boxes, extra = found.setdefault(key, (name, {}, {}))
            boxes[f], extra[f] = Box.of(frame.boxes[k], KEY), said
    tracks = [Track(number, name, ACCEPTED, 1.0, IMPORTED, boxes, frozenset(), extra)
              for number, (name, boxes, extra) in enumerate(found.values(), first_id)]
    notes = {str(f): replace_non_finite(frame.notes)
             for f, frame in enumerate(labels.frames) if frame.notes}
    return tracks, {"notes": notes, "extra": replace_non_finite(labels.extra)}


def digest_of(tracks: Sequence[Track], kept: Kept) -> str:
    """Of what from_labels gave, whatever the numbers of the tracks are."""
    rows = [{**track_to_json(t), "id": 0} for t in tracks]
    return hashlib.sha256(json.dumps([rows, kept], sort_keys=True).encode()).hexdigest()[:16]


def joined(before: Kept, new: Kept) -> dict[str, Any]:
    """State.kept after another import: nothing of the one before is lost."""
    notes = {f: list(rows) for f, rows in before.get("notes", {}).items()}
    for f, rows in new["notes"].items():
        there = notes.setdefault(f, [])
        there += [row for row in rows if row not in there]
    return {"notes": notes, "extra": {**before.get("extra", {}), **new["extra"]}}


def to_labels(state: State, frames: Sequence[Frame]) -> DriveLabels:
    """The accepted tracks, frame by frame, by their ids, or by those that they were imported
    with."""
    ids = _exported_ids(state)
    rows: list[list[tuple[Track, Box, dict[str, Any]]]] = [[] for _ in frames]
    for number in sorted(ids):
        track = state.tracks[number]
        for f, box in track.boxes.items():
            rows[f].append((track, box, track.extra.get(f, {})))
    notes = state.kept.get("notes", {})
    return DriveLabels([
        FrameLabels.of(frame.name, frame.stamp_ns, [box.values for _, box, _ in rows[f]],
                       [track.class_name for track, _, _ in rows[f]],
                       [ids[track.id] for track, _, _ in rows[f]],
                       [said.get(SCORE, math.nan) for _, _, said in rows[f]],
                       [said.get(REST, {}) for _, _, said in rows[f]],
                       [(name, said) for name, said in notes.get(str(f), [])])
        for f, frame in enumerate(frames)], dict(state.kept.get("extra", {})))


def _exported_ids(state: State) -> dict[int, int]:
    """Of the accepted tracks."""
    chosen = [t for t in state.tracks.values() if t.state == ACCEPTED]
    found: dict[int, int] = {}
    taken = set[int]()
    for t in chosen:
        said = {extra[ID] for extra in t.extra.values() if ID in extra}
        if len(t.boxes) > 1:  # boxes without an id that a person joined are a track
            said.discard(NO_TRACK)
        if len(said) == 1 and (number := said.pop()) not in taken:
            found[t.id] = number
            taken |= {number} - {NO_TRACK}
    for t in chosen:
        if t.id not in found:
            found[t.id] = t.id if t.id not in taken else max(taken | set(state.tracks)) + 1
            taken.add(found[t.id])
    return found

