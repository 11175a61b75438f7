"""Conversion between tracks and the labels of a drive, for import and export.

Further fields of an imported file are preserved for export: Track.extra contains fields of boxes, and
State.preserved_fields contains fields of frames and of the drive.
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
from lidar_studio.state import ACCEPTED, KEY, Box, PreservedFields, State, Track, track_to_json

IMPORTED = "imported"  # source of an imported track
ID, SCORE, REST = "track_id", "score", "rest"  # keys of Track.extra


def to_tracks(labels: DriveLabels, first_id: int) -> tuple[list[Track], dict[str, Any]]:
    """Convert labels to accepted tracks of key boxes, and to the value of State.preserved_fields.

    Boxes with the same track id and class form one track. A box without an id becomes a separate track.
    The ids of the new tracks start at `first_id`.
    """
    tracks_by_key: dict[tuple[Any, ...], tuple[str, dict[int, Box], dict[int, dict[str, Any]]]] = {}
    for f, frame in enumerate(labels.frames):
        for k, name in enumerate(frame.class_names):
            track_id, score = int(frame.track_ids[k]), float(frame.scores[k])
            fields = {
                ID: track_id,
                REST: replace_non_finite(frame.extra[k]),
                **({} if math.isnan(score) else {SCORE: score}),
            }
            key = (track_id, name) if track_id != NO_TRACK else (NO_TRACK, f, k)
            if key in tracks_by_key and f in tracks_by_key[key][1]:  # the id occurs twice in this frame
                key = NO_TRACK, f, k
            _, boxes, extra = tracks_by_key.setdefault(key, (name, {}, {}))
            boxes[f], extra[f] = Box.from_array(frame.boxes[k], KEY), fields
    tracks = [
        Track(track_id, name, ACCEPTED, 1.0, IMPORTED, boxes, frozenset(), extra)
        for track_id, (name, boxes, extra) in enumerate(tracks_by_key.values(), first_id)
    ]
    notes = {str(f): replace_non_finite(frame.notes) for f, frame in enumerate(labels.frames) if frame.notes}
    return tracks, {"notes": notes, "extra": replace_non_finite(labels.extra)}


def compute_digest(tracks: Sequence[Track], preserved_fields: PreservedFields) -> str:
    """Compute a digest of the result of to_tracks(), independent of the track ids."""
    rows = [{**track_to_json(t), "id": 0} for t in tracks]
    return hashlib.sha256(json.dumps([rows, preserved_fields], sort_keys=True).encode()).hexdigest()[:16]


def merge_preserved_fields(old_fields: PreservedFields, new_fields: PreservedFields) -> dict[str, Any]:
    """Merge State.preserved_fields with the preserved fields of another import."""
    notes = {f: list(rows) for f, rows in old_fields.get("notes", {}).items()}
    for f, rows in new_fields["notes"].items():
        frame_notes = notes.setdefault(f, [])
        frame_notes += [row for row in rows if row not in frame_notes]
    return {"notes": notes, "extra": {**old_fields.get("extra", {}), **new_fields["extra"]}}


def to_labels(state: State, frames: Sequence[Frame]) -> DriveLabels:
    """Convert the accepted tracks to labels by frame. Imported tracks keep their original ids."""
    ids = _choose_ids(state)
    rows: list[list[tuple[Track, Box, dict[str, Any]]]] = [[] for _ in frames]
    for track_id in sorted(ids):
        track = state.tracks[track_id]
        for f, box in track.boxes.items():
            rows[f].append((track, box, track.extra.get(f, {})))
    notes = state.preserved_fields.get("notes", {})
    return DriveLabels(
        [
            FrameLabels.of(
                frame.name,
                frame.stamp_ns,
                [box.values for _, box, _ in rows[f]],
                [track.class_name for track, _, _ in rows[f]],
                [ids[track.id] for track, _, _ in rows[f]],
                [fields.get(SCORE, math.nan) for _, _, fields in rows[f]],
                [fields.get(REST, {}) for _, _, fields in rows[f]],
                [(name, fields) for name, fields in notes.get(str(f), [])],
            )
            for f, frame in enumerate(frames)
        ],
        dict(state.preserved_fields.get("extra", {})),
    )


def _choose_ids(state: State) -> dict[int, int]:
    """Choose unique ids for the export of the accepted tracks. Imported ids are kept where possible."""
    accepted_tracks = [t for t in state.tracks.values() if t.state == ACCEPTED]
    ids: dict[int, int] = {}
    used_ids = set[int]()
    for t in accepted_tracks:
        imported_ids = {extra[ID] for extra in t.extra.values() if ID in extra}
        if len(t.boxes) > 1:  # a person may have merged boxes without an id
            imported_ids.discard(NO_TRACK)
        if len(imported_ids) == 1 and (imported_id := imported_ids.pop()) not in used_ids:
            ids[t.id] = imported_id
            used_ids |= {imported_id} - {NO_TRACK}
    for t in accepted_tracks:
        if t.id not in ids:
            ids[t.id] = t.id if t.id not in used_ids else max(used_ids | set(state.tracks)) + 1
            used_ids.add(ids[t.id])
    return ids
