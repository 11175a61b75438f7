"""ASAM OpenLABEL 1.0: one JSON file per drive, with cuboids whose orientation is a quaternion.

A cuboid is [x y z qx qy qz qw sx sy sz]: centre, orientation in its coordinate system, and sizes
along its axes. Cuboids are written with x along the length to the front, y to the left and z up, as
in ISO 8855, in the LiDAR's coordinate system. Frames are numbered as in the drive. Other content of
a file is preserved: fields of a cuboid in FrameLabels.extra, fields of the drive in
DriveLabels.extra.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.classes import find_class_name
from lidar_perception.data.frame import Frame
from lidar_perception.data.kitti.labels import COLUMNS, DONT_CARE
from lidar_perception.labels.drive_labels import (
    NO_TRACK,
    DriveLabels,
    FrameLabels,
    Row,
    is_unchanged,
    make_frame_labels,
)
from lidar_perception.labels.formats import openlabel_parts as parts
from lidar_perception.labels.formats.files import (
    assign_track_ids,
    collect_track_names,
    find_drive_files,
    group_by_sequence,
    is_track_number,
    read_json,
    report_format_errors,
    write_drives,
    write_json,
)
from lidar_perception.types import InputError

SUFFIX, ROOT = ".json", "openlabel"
SCORE, TRACKED, TYPE = "confidence", "tracked", "type"  # attributes of a cuboid
UID = "uid"  # key in `extra` and in notes: id of the object in the file
OTHER = "openlabel_attributes"  # key in `extra`: attributes that are not plain values
OBJECT = "openlabel_data"  # key in `extra` and in notes: data of the object
ORIGINAL = "openlabel_cuboid"  # key in `extra`: original cuboid, which is written unless the box was changed
REGION = "openlabel_region"  # key in a note: data of the object whose 2D boxes were read as notes
REGION_CLASS = "DontCare"
PROPERTIES, DATA, CUBOIDS = "frame_properties", "object_data", "cuboid"  # keys of the format


def read(path: Path, frames: Sequence[Frame]) -> DriveLabels:
    """Read one JSON file, or a folder with one DRIVE.json per drive."""
    files = find_drive_files(path, frames, SUFFIX)
    labels: list[FrameLabels] = []
    extra = {}
    for drive, positions in group_by_sequence(frames).items():
        drive_frames = [frames[i] for i in positions]
        if drive not in files:
            labels += [make_frame_labels(frame, ()) for frame in drive_frames]
            continue
        with report_format_errors(files[drive]):
            drive_labels, extra[drive] = _read_drive(files[drive], drive_frames)
        labels += drive_labels
    return DriveLabels(labels, {ROOT: extra})


def _read_drive(path: Path, frames: list[Frame]) -> tuple[list[FrameLabels], dict[str, Any]]:
    """Return the labels of each frame in the file of a drive, and the other content of the file."""
    content, source = dict(read_json(path)[ROOT]), str(path)
    objects, systems = content.get("objects", {}), content.get("coordinate_systems", {})
    frame_contents = content.get("frames", {})
    if unknown_numbers := sorted(set(frame_contents) - {str(frame.index) for frame in frames}):
        raise InputError(
            f"{source} has labels of frame {unknown_numbers[0]!r} ({len(unknown_numbers)} unknown frames), "
            f"but the drive has frames {frames[0].index} to {frames[-1].index}; give the "
            "drive that was labelled"
        )
    numbers = assign_track_ids(
        [*objects, *(uid for frame in frame_contents.values() for uid in frame.get("objects", {}))]
    )
    labels = []
    for frame in frames:
        frame_content = frame_contents.get(str(frame.index), {})
        rows: list[Row] = []
        notes: list[tuple[str, dict[str, Any]]] = []
        for uid, element in frame_content.get("objects", {}).items():
            data = dict(element.get(DATA, {}))
            object_class = find_class_name(str(objects.get(uid, {}).get("type", "")))
            uid_field = {} if str(numbers[uid]) == uid else {UID: uid}
            cuboids = [
                cuboid for cuboid in data.get(CUBOIDS, ()) if object_class != REGION_CLASS and parts.has_size(cuboid)
            ]
            if not cuboids:
                notes += _make_region_notes(object_class, uid, data)
                continue
            data[CUBOIDS] = [cuboid for cuboid in data[CUBOIDS] if cuboid not in cuboids]
            data = {key: items for key, items in data.items() if items}
            for k, cuboid in enumerate(cuboids):
                system = cuboid.get("coordinate_system", "")
                box, is_upright = parts.cuboid_to_box(
                    cuboid["val"], parts.find_transform_to_lidar(system, systems, frame_content, frame, source)
                )
                rows.append(
                    (
                        box,
                        *_parse_track(cuboid, object_class, numbers[uid]),
                        {
                            **uid_field,
                            **({OBJECT: data} if data and k == 0 else {}),
                            **_parse_extra(
                                cuboid, box, is_upright and system in ("", parts.find_lidar_system(systems, source))
                            ),
                        },
                    )
                )
        labels.append(make_frame_labels(frame, rows, notes, f"{source}, frame {frame.index}"))
    return labels, {
        **content,
        "frames": {
            number: {
                **{key: value for key, value in frame.items() if key != "objects"},
                PROPERTIES: dict(frame.get(PROPERTIES, {})),
            }
            for number, frame in frame_contents.items()
        },
    }


def _make_region_notes(object_class: str, uid: str, data: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """Make the notes of an object without a cuboid.

    Each 2D box becomes a note with KITTI's columns; the first note also has the object's data. An
    object without 2D boxes becomes a single note with its data.
    """
    values, other_items = parts.parse_named_values(data)
    columns = {name: DONT_CARE[name] for name in COLUMNS if name in DONT_CARE}
    notes = [
        (object_class, {**columns, **values, "bbox": box, UID: uid, REGION: {} if k else data})
        for k, box in enumerate(parts.find_regions(data))
    ]
    return notes or [
        (object_class, {**values, **({OBJECT: other_items} if other_items else {}), **({} if values else {UID: uid})})
    ]


def _parse_track(cuboid: dict[str, Any], object_class: str, number: int) -> tuple[str, int, float]:
    """Return the class, track id and score of a cuboid."""
    values, _ = parts.parse_named_values(cuboid.get("attributes", {}))
    return (
        find_class_name(values.get(TYPE, object_class)),
        number if values.get(TRACKED, True) else NO_TRACK,
        values.get(SCORE, np.nan),
    )


def _parse_extra(cuboid: dict[str, Any], box: list[float], is_plain: bool) -> dict[str, Any]:
    """Return the extra fields of a cuboid, with the original cuboid unless the box describes it completely."""
    values, other_items = parts.parse_named_values(cuboid.get("attributes", {}))
    extra = {name: v for name, v in values.items() if name not in (SCORE, TRACKED, TYPE)}
    extra |= {OTHER: other_items} if other_items else {}
    if not is_plain or set(cuboid) - {"val", "attributes", "name", "coordinate_system"}:
        extra[ORIGINAL] = {**{k: v for k, v in cuboid.items() if k != "attributes"}, "box": box}
    return extra


def write(labels: DriveLabels, out: Path, frames: Sequence[Frame], force: bool = False) -> None:
    """Write FILE.json, or a folder with one file per drive; numbers are stored without rounding."""
    original = labels.extra.get(ROOT, {})

    def write_drive(file: Path, drive: str, positions: list[int]) -> None:
        write_json(file, _make_content(labels, frames, positions, original.get(drive, {})))

    write_drives(out, frames, SUFFIX, force, write_drive)


def _make_content(
    labels: DriveLabels, frames: Sequence[Frame], positions: Sequence[int], original: dict[str, Any]
) -> dict[str, Any]:
    """Return the content of the file of a drive.

    `positions` are the positions of the drive's frames in `frames`; `original` is the content of the file
    that was read, without cuboids, or {}.
    """
    drive_frames = [(frames[i], labels.frames[i]) for i in positions]
    named_tracks = collect_track_names((frame_labels for _, frame_labels in drive_frames), UID)
    note_uids = {str(note[UID]) for _, frame_labels in drive_frames for _, note in frame_labels.notes if UID in note}
    used_uids = (
        {str(i) for _, frame_labels in drive_frames for i in frame_labels.track_ids.tolist()}
        | {*named_tracks.values()}
        | note_uids
    )
    objects = {
        uid: dict(o)
        for uid, o in original.get("objects", {}).items()
        if uid in used_uids or not o.get("frame_intervals")
    }  # objects that are still used, or not bound to frames
    systems = (
        original
        if original.get("coordinate_systems")
        else parts.make_coordinate_systems([frame for frame, _ in drive_frames])
    )
    lidar = parts.find_lidar_system(systems["coordinate_systems"], "the file that was read")
    numbers = [int(uid) for uid in (*used_uids, *objects) if is_track_number(uid)]
    new_numbers = itertools.count(max([0, *numbers]) + 1)
    frame_contents: dict[str, Any] = {}
    frames_by_object: dict[str, list[int]] = {}

    def get_object_data(uid: str, object_class: str, index: int) -> dict[str, Any]:
        """Return the data of an object in a frame, and add the object if it is new."""
        if uid not in frames_by_object:
            known_object = objects.get(uid, {})
            same_class = find_class_name(str(known_object.get("type", ""))) == object_class
            objects[uid] = {
                "name": f"{object_class} {uid}",
                **known_object,
                "type": known_object["type"] if same_class else object_class,
            }
        frames_by_object.setdefault(uid, []).append(index)
        frame_objects = frame_contents[str(index)].setdefault("objects", {})
        data: dict[str, Any] = frame_objects.setdefault(uid, {DATA: {}})[DATA]
        return data

    for frame, frame_labels in drive_frames:
        original_content = original.get("frames", {}).get(str(frame.index), {})
        frame_contents[str(frame.index)] = {
            **original_content,
            PROPERTIES: {
                **({} if systems is original else parts.make_transforms(frame)),
                **original_content.get(PROPERTIES, {}),
                "name": frame.name,
                "timestamp": f"{frame.stamp_ns / 1e9:.9f}",
            },
        }
        for k, (object_class, extra) in enumerate(zip(frame_labels.class_names, frame_labels.extra)):
            track = int(frame_labels.track_ids[k])
            uid = named_tracks.get(track, str(next(new_numbers) if track == NO_TRACK else track))
            data = get_object_data(uid, object_class, frame.index)
            data |= {key: value for key, value in extra.get(OBJECT, {}).items() if key not in data}
            data.setdefault(CUBOIDS, []).append(_make_cuboid(frame_labels, k, objects[uid]["type"], lidar))
        for object_class, note in frame_labels.notes:
            values = {key: value for key, value in note.items() if key not in (UID, OBJECT)}
            get_object_data(str(note.get(UID, next(new_numbers))), object_class, frame.index).update(
                note[REGION] if REGION in note else {**parts.to_named_values(values), **note.get(OBJECT, {})}
            )
    for uid, indices in frames_by_object.items():
        objects[uid]["frame_intervals"] = parts.find_intervals(indices)
    return {
        ROOT: {
            "metadata": {"schema_version": "1.0.0"},
            **original,
            **systems,
            "frames": frame_contents,
            "objects": objects,
            "frame_intervals": parts.find_intervals([frame.index for frame, _ in drive_frames]),
        }
    }


def _make_cuboid(labels: FrameLabels, k: int, object_class: str, lidar: str) -> dict[str, Any]:
    box, extra = labels.boxes[k], labels.extra[k]
    x, y, z, length, width, height, yaw = box.tolist()
    cuboid = {
        "name": "box",
        "coordinate_system": lidar,
        "val": [x, y, z, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2), length, width, height],
    }
    if ORIGINAL in extra and is_unchanged(box, extra[ORIGINAL]["box"]):
        cuboid = {key: value for key, value in extra[ORIGINAL].items() if key != "box"}
    values = {name: v for name, v in extra.items() if name not in (UID, OTHER, OBJECT, ORIGINAL)}
    values |= {SCORE: float(labels.scores[k])} if np.isfinite(labels.scores[k]) else {}
    values |= {TRACKED: False} if labels.track_ids[k] == NO_TRACK else {}
    values |= {TYPE: labels.class_names[k]} if labels.class_names[k] != find_class_name(object_class) else {}
    attributes = parts.to_named_values(values)
    for name, items in extra.get(OTHER, {}).items():
        attributes.setdefault(name, []).extend(items)
    return {**cuboid, **({"attributes": attributes} if attributes else {})}
