"""Result files of nuScenes' detection and tracking tasks: one JSON file, a list of boxes for each
sample, in the global frame, to which the recording's poses lead.

size is [width length height], rotation [w x y z], with x to the front. A frame that is none of
nuScenes' has its name as token. Fields that nuScenes does not know are written beside its own, and
nuscenes-devkit passes over them; classes that it does not know are written as they are, and it
refuses them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.classes import TABLE
from lidar_perception.data.frame import Frame
from lidar_perception.data.nuscenes.boxes import (
    GlobalBoxes,
    are_tilted,
    are_valid_rotations,
    to_global_boxes,
    to_local_boxes,
)
from lidar_perception.data.nuscenes.labels import CLASS_BY_NAME
from lidar_perception.data.nuscenes.results import META, NAME_BY_CLASS, format_boxes
from lidar_perception.labels.drive_labels import (
    NO_TRACK,
    DriveLabels,
    FrameLabels,
    Row,
    of_rows,
    unchanged,
)
from lidar_perception.labels.formats.files import (
    beside,
    extra_of,
    in_file,
    read_json,
    track_names,
    track_numbers,
)
from lidar_perception.runs.files import check_unused, write_text
from lidar_perception.types import InputError

ROOT = "nuscenes"
NO_SCORE = -1.0    # as nuscenes-devkit writes labels
OURS = {**CLASS_BY_NAME, **{theirs: ours for ours, theirs in NAME_BY_CLASS.items()}}
THEIRS = {ours: theirs for theirs, ours in OURS.items()}
# What is theirs under another name of ours, which stands beside it: vans are cars.
LIKE = {row.name: THEIRS[row.looks_like] for row in TABLE if row.looks_like in THEIRS}
WRITTEN = {**THEIRS, **LIKE}
# What is ours with a rider, and theirs also without one.
RIDDEN, NOT_RIDDEN = OURS.keys() - CLASS_BY_NAME.keys(), "cycle.without_rider"
OWN = {"sample_token", "translation", "size", "rotation", "velocity", "tracking_id",
       "attribute_name"}


def _token(frame: Frame) -> str:
    return str(getattr(frame.native, "token", frame.name))


def _pose(frame: Frame) -> np.ndarray:
    pose = frame.pose()
    if pose is None:
        raise InputError(f"frame {frame.name} has no pose, and nuScenes' boxes are in a fixed "
                         "frame; take openlabel, labelcloud or sustech, which need none")
    return pose


def _read(task: str, path: Path, frames: Sequence[Frame]) -> DriveLabels:
    """Boxes of samples that the drive has not are left out: one file is of many drives."""
    content = read_json(path)
    results = in_file(str(path), lambda: dict(content["results"]))
    if not results.keys() & {_token(frame) for frame in frames}:
        raise InputError(f"{path} has none of the drive's samples, whose first is "
                         f"{_token(frames[0])}; give the results of this drive")
    ids = in_file(str(path), lambda: track_numbers({str(row.get("tracking_id", ""))
                                                    for rows in results.values()
                                                    for row in rows} - {""}))
    labels = []
    for frame in frames:
        where = f"{path}, sample {_token(frame)}"
        rows = in_file(where, partial(_rows, task, frame, results.get(_token(frame), []), ids))
        labels.append(of_rows(frame, rows, where=where))
    return DriveLabels(labels, {ROOT: {key: v for key, v in content.items() if key != "results"}})


def _rows(task: str, frame: Frame, boxes: list[dict[str, Any]], ids: dict[str, int]) -> list[Row]:
    rows: list[Row] = []
    pose = _pose(frame) if boxes else np.eye(4)  # without a box there is no need of one
    for row in boxes:
        kind, attribute = str(row[f"{task}_name"]), row.get("attribute_name", "")
        rest = extra_of(row, OWN | {f"{task}_name", f"{task}_score"})
        if attribute:
            rest["attribute"] = attribute
        if (velocity := _finite(row.get("velocity"))) is not None:
            rest["velocity"] = velocity
        box, leans = _in_frame(row, pose)
        if leans:
            rest["rotation"] = row["rotation"]
        track = str(row.get("tracking_id", ""))
        if track and track != str(ids[track]):
            rest["tracking_id"] = track
        score = float(row.get(f"{task}_score", NO_SCORE))
        if (finer := rest.get("class_name")) in LIKE and LIKE[finer] == kind:
            kind = rest.pop("class_name")
        kind = kind if attribute == NOT_RIDDEN else OURS.get(kind, kind)
        rows.append((box, kind, ids.get(track, NO_TRACK), np.nan if score < 0 else score, rest))
    return rows


def _finite(velocity: Any) -> list[float] | None:
    known = velocity is not None and None not in velocity and np.isfinite(velocity).all()
    return [float(v) for v in velocity] if known else None


def _in_frame(row: dict[str, Any], pose: np.ndarray) -> tuple[list[float], bool]:
    """The box, and whether it leans there."""
    width, length, height = row["size"]
    one = GlobalBoxes.of([row["translation"]], [[length, width, height]], [row["rotation"]], 0)
    if not are_valid_rotations(one.rotations).all():
        raise ValueError("a rotation is no quaternion")
    return to_local_boxes(one, pose)[0].tolist(), bool(are_tilted(one, pose)[0])


def rotation_read(labels: FrameLabels, k: int, pose: np.ndarray) -> list[float] | None:
    """[w x y z] with which a box that leans was read, where it is still there; else None."""
    rotation, box = labels.extra[k].get("rotation"), labels.boxes[k]
    if not isinstance(rotation, list) or len(rotation) != 4:
        return None
    centre, size, _ = to_global_boxes(box[None], pose)
    place = {"translation": centre[0], "size": size[0][[1, 0, 2]], "rotation": rotation}
    with suppress(ValueError, TypeError, OverflowError):  # another tool's field of this name
        return rotation if unchanged(box, _in_frame(place, pose)[0]) else None
    return None


def _write(task: str, labels: DriveLabels, out: Path, frames: Sequence[Frame],
           force: bool = False) -> None:
    """out: one JSON file. Velocities that the labels do not have are those of the tracks, from
    frame to frame; NaN, which nuscenes-devkit reads, where there is none."""
    check_unused(out, force)
    poses = {i: _pose(frame) for i, frame in enumerate(frames) if len(labels.frames[i])}
    speeds, names = _velocities(labels, frames, poses), track_names(labels.frames, "tracking_id")
    results = {}
    for i, (each, frame) in enumerate(zip(labels.frames, frames)):
        placed = format_boxes(_token(frame), *to_global_boxes(
            each.boxes, poses[i])) if len(each) else []
        results[_token(frame)] = [
            {**place, **_columns(task, each, k, poses[i], speeds.get((i, k), [np.nan] * 2), names)}
            for k, place in enumerate(placed)]
    write_text(out, json.dumps({"meta": META, **labels.extra.get(ROOT, {}), "results": results}))


def _columns(task: str, labels: FrameLabels, k: int, pose: np.ndarray,
             velocity: list[float], names: dict[int, str]) -> dict[str, Any]:
    """What else a box says, see _write."""
    kind, track = labels.class_names[k], int(labels.track_ids[k])
    extra = dict(labels.extra[k])
    attribute = extra.pop("attribute", None) or ""
    if kind in RIDDEN:
        attribute = NOT_RIDDEN
    elif THEIRS.get(kind) in RIDDEN and attribute == NOT_RIDDEN:
        attribute = ""  # a person said otherwise
    extra.pop("tracking_id", None)
    if kind in LIKE:
        extra["class_name"] = kind
    if isinstance(said := extra.pop("velocity", None), list) and len(said) == 2:
        velocity = _finite(said) or velocity
    columns = {"velocity": velocity, "attribute_name": attribute,
               f"{task}_name": WRITTEN.get(kind, kind),
               f"{task}_score": (float(labels.scores[k]) if np.isfinite(labels.scores[k])
                                 else NO_SCORE)}
    if task == "tracking" or track != NO_TRACK:
        columns["tracking_id"] = "" if track == NO_TRACK else names.get(track, str(track))
    if rotation := rotation_read(labels, k, pose):
        columns["rotation"] = rotation
    extra.pop("rotation", None)
    return {**beside(extra, OWN | columns.keys()), **columns}


def _velocities(labels: DriveLabels, frames: Sequence[Frame],
                poses: dict[int, np.ndarray]) -> dict[tuple[int, int], list[float]]:
    """By frame and box: m/s in the fixed frame, of a track from the frame before to that after.
    poses: of the frames with boxes."""
    tracks: dict[tuple[str, int], list[tuple[int, int]]] = {}
    for i, (each, frame) in enumerate(zip(labels.frames, frames)):
        for k, track in enumerate(each.track_ids.tolist()):
            if track != NO_TRACK:
                tracks.setdefault((frame.sequence, track), []).append((i, k))
    found = {}
    for places_ in tracks.values():
        at = np.array([(poses[i] @ [*labels.frames[i].boxes[k, :3], 1.0])[:2]
                       for i, k in places_])
        seconds = np.array([frames[i].stamp_ns for i, _ in places_], np.int64)
        for n, place in enumerate(places_):
            first, last = max(n - 1, 0), min(n + 1, len(places_) - 1)
            if (time := (seconds[last] - seconds[first]) * 1e-9) > 0:
                found[place] = ((at[last] - at[first]) / time).tolist()
    return found


detection, tracking = ((partial(_read, task), partial(_write, task))
                       for task in ("detection", "tracking"))
