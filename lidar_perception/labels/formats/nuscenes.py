"""Result files of nuScenes' detection and tracking tasks: JSON files with the boxes of each sample.

Boxes are in the global frame, so the recording needs poses. size is [width length height] and
rotation is [w x y z], with x forward. The name of a frame is its sample token, unless it comes from
nuScenes. nuscenes-devkit ignores additional fields and rejects unknown classes; both are written.
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
    is_unchanged,
    make_frame_labels,
)
from lidar_perception.labels.formats.files import (
    assign_track_ids,
    collect_track_names,
    extract_extra,
    merge_extra,
    read_json,
    report_format_errors,
)
from lidar_perception.runs.files import check_unused, write_text
from lidar_perception.types import InputError

ROOT = "nuscenes"
NO_SCORE = -1.0  # score of labels, as in nuscenes-devkit
CLASS_BY_NUSCENES_NAME = {**CLASS_BY_NAME, **{name: our_name for our_name, name in NAME_BY_CLASS.items()}}
NUSCENES_NAME_BY_CLASS = {our_name: name for name, our_name in CLASS_BY_NUSCENES_NAME.items()}
# Class that nuScenes lacks, such as Van -> similar nuScenes class; the original name is written as a field.
SIMILAR_NAME_BY_CLASS = {
    row.name: NUSCENES_NAME_BY_CLASS[row.looks_like] for row in TABLE if row.looks_like in NUSCENES_NAME_BY_CLASS
}
WRITTEN_NAME_BY_CLASS = {**NUSCENES_NAME_BY_CLASS, **SIMILAR_NAME_BY_CLASS}
# nuScenes classes that correspond to a class of this package only with a rider.
RIDDEN_CLASSES, WITHOUT_RIDER = CLASS_BY_NUSCENES_NAME.keys() - CLASS_BY_NAME.keys(), "cycle.without_rider"
OWN_FIELDS = {"sample_token", "translation", "size", "rotation", "velocity", "tracking_id", "attribute_name"}


def _get_token(frame: Frame) -> str:
    return str(getattr(frame.native, "token", frame.name))


def _require_pose(frame: Frame) -> np.ndarray:
    pose = frame.pose()
    if pose is None:
        raise InputError(
            f"frame {frame.name} has no pose, but nuScenes' boxes are in a global "
            "frame; use openlabel, labelcloud or sustech, which need no poses"
        )
    return pose


def _read(task: str, path: Path, frames: Sequence[Frame]) -> DriveLabels:
    """Read a result file; the boxes of other drives in it are ignored."""
    content = read_json(path)
    with report_format_errors(path):
        results = dict(content["results"])
    if not results.keys() & {_get_token(frame) for frame in frames}:
        raise InputError(
            f"{path} has no samples of this drive, such as {_get_token(frames[0])}; give the results of this drive"
        )
    with report_format_errors(path):
        ids = assign_track_ids({str(row.get("tracking_id", "")) for rows in results.values() for row in rows} - {""})
    labels = []
    for frame in frames:
        source = f"{path}, sample {_get_token(frame)}"
        with report_format_errors(source):
            rows = _parse_boxes(task, frame, results.get(_get_token(frame), []), ids)
            labels.append(make_frame_labels(frame, rows, source=source))
    return DriveLabels(labels, {ROOT: {key: v for key, v in content.items() if key != "results"}})


def _parse_boxes(task: str, frame: Frame, boxes: list[dict[str, Any]], ids: dict[str, int]) -> list[Row]:
    rows: list[Row] = []
    pose = _require_pose(frame) if boxes else np.eye(4)  # without boxes, no pose is needed
    for row in boxes:
        class_name, attribute = str(row[f"{task}_name"]), row.get("attribute_name", "")
        extra = extract_extra(row, OWN_FIELDS | {f"{task}_name", f"{task}_score"})
        if attribute:
            extra["attribute"] = attribute
        if (velocity := _parse_velocity(row.get("velocity"))) is not None:
            extra["velocity"] = velocity
        box, is_tilted = _to_local_box(row, pose)
        if is_tilted:
            extra["rotation"] = row["rotation"]
        track = str(row.get("tracking_id", ""))
        if track and track != str(ids[track]):
            extra["tracking_id"] = track
        score = float(row.get(f"{task}_score", NO_SCORE))
        if SIMILAR_NAME_BY_CLASS.get(extra.get("class_name", "")) == class_name:
            class_name = extra.pop("class_name")
        class_name = class_name if attribute == WITHOUT_RIDER else CLASS_BY_NUSCENES_NAME.get(class_name, class_name)
        rows.append((box, class_name, ids.get(track, NO_TRACK), np.nan if score < 0 else score, extra))
    return rows


def _parse_velocity(velocity: Any) -> list[float] | None:
    is_valid = velocity is not None and None not in velocity and np.isfinite(velocity).all()
    return [float(v) for v in velocity] if is_valid else None


def _to_local_box(row: dict[str, Any], pose: np.ndarray) -> tuple[list[float], bool]:
    """Return a box in the frame with this pose, and True if it is tilted in that frame."""
    width, length, height = row["size"]
    box = GlobalBoxes.of([row["translation"]], [[length, width, height]], [row["rotation"]], 0)
    if not are_valid_rotations(box.rotations).all():
        raise ValueError("a rotation is not a quaternion")
    return to_local_boxes(box, pose)[0].tolist(), bool(are_tilted(box, pose)[0])


def find_original_rotation(labels: FrameLabels, k: int, pose: np.ndarray) -> list[float] | None:
    """Return the original rotation [w x y z] of a tilted box; None if the box has changed."""
    rotation, box = labels.extra[k].get("rotation"), labels.boxes[k]
    if not isinstance(rotation, list) or len(rotation) != 4:
        return None
    centre, size, _ = to_global_boxes(box[None], pose)
    placement = {"translation": centre[0], "size": size[0][[1, 0, 2]], "rotation": rotation}
    with suppress(ValueError, TypeError, OverflowError):  # the field may come from another tool
        return rotation if is_unchanged(box, _to_local_box(placement, pose)[0]) else None
    return None


def _write(task: str, labels: DriveLabels, out: Path, frames: Sequence[Frame], force: bool = False) -> None:
    """Write a JSON file.

    Missing velocities are computed from the tracks. For boxes without a track they are NaN, which
    nuscenes-devkit can read.
    """
    check_unused(out, force)
    poses = {i: _require_pose(frame) for i, frame in enumerate(frames) if len(labels.frames[i])}
    velocities = _compute_velocities(labels, frames, poses)
    names = collect_track_names(labels.frames, "tracking_id")
    results = {}
    for i, (frame_labels, frame) in enumerate(zip(labels.frames, frames)):
        placements = (
            format_boxes(_get_token(frame), *to_global_boxes(frame_labels.boxes, poses[i])) if len(frame_labels) else []
        )
        results[_get_token(frame)] = [
            {**placement, **_make_columns(task, frame_labels, k, poses[i], velocities.get((i, k), [np.nan] * 2), names)}
            for k, placement in enumerate(placements)
        ]
    write_text(out, json.dumps({"meta": META, **labels.extra.get(ROOT, {}), "results": results}))


def _make_columns(
    task: str, labels: FrameLabels, k: int, pose: np.ndarray, velocity: list[float], names: dict[int, str]
) -> dict[str, Any]:
    """Return the fields of a box other than its position and size."""
    class_name, track = labels.class_names[k], int(labels.track_ids[k])
    extra = dict(labels.extra[k])
    attribute = extra.pop("attribute", None) or ""
    if class_name in RIDDEN_CLASSES:
        attribute = WITHOUT_RIDER
    elif NUSCENES_NAME_BY_CLASS.get(class_name) in RIDDEN_CLASSES and attribute == WITHOUT_RIDER:
        attribute = ""  # the attribute is no longer valid, because the class was changed by hand
    extra.pop("tracking_id", None)
    if class_name in SIMILAR_NAME_BY_CLASS:
        extra["class_name"] = class_name
    if isinstance(read_velocity := extra.pop("velocity", None), list) and len(read_velocity) == 2:
        velocity = _parse_velocity(read_velocity) or velocity
    columns = {
        "velocity": velocity,
        "attribute_name": attribute,
        f"{task}_name": WRITTEN_NAME_BY_CLASS.get(class_name, class_name),
        f"{task}_score": (float(labels.scores[k]) if np.isfinite(labels.scores[k]) else NO_SCORE),
    }
    if task == "tracking" or track != NO_TRACK:
        columns["tracking_id"] = "" if track == NO_TRACK else names.get(track, str(track))
    if rotation := find_original_rotation(labels, k, pose):
        columns["rotation"] = rotation
    extra.pop("rotation", None)
    return {**merge_extra(extra, OWN_FIELDS | columns.keys()), **columns}


def _compute_velocities(
    labels: DriveLabels, frames: Sequence[Frame], poses: dict[int, np.ndarray]
) -> dict[tuple[int, int], list[float]]:
    """Return the velocity [x y] in m/s of box k in frame i by (i, k), from the previous and next box of its track."""
    tracks: dict[tuple[str, int], list[tuple[int, int]]] = {}
    for i, (frame_labels, frame) in enumerate(zip(labels.frames, frames)):
        for k, track in enumerate(frame_labels.track_ids.tolist()):
            if track != NO_TRACK:
                tracks.setdefault((frame.sequence, track), []).append((i, k))
    velocities = {}
    for boxes in tracks.values():
        positions = np.array([(poses[i] @ [*labels.frames[i].boxes[k, :3], 1.0])[:2] for i, k in boxes])
        stamps = np.array([frames[i].stamp_ns for i, _ in boxes], np.int64)
        for n, box in enumerate(boxes):
            previous, following = max(n - 1, 0), min(n + 1, len(boxes) - 1)
            if (seconds := (stamps[following] - stamps[previous]) * 1e-9) > 0:
                velocities[box] = ((positions[following] - positions[previous]) / seconds).tolist()
    return velocities


detection_format, tracking_format = (
    (partial(_read, task), partial(_write, task)) for task in ("detection", "tracking")
)
