"""ASAM OpenLABEL 1.0: one JSON file a drive, cuboids with a quaternion.

A cuboid is [x y z qx qy qz qw sx sy sz]: its centre, where its axes point in its coordinate system,
and its sizes along them. Here, as in ISO 8855, x is along the length to the front, y to the left, z
up; the coordinate system is the LiDAR's. Frames have the numbers that they have in the drive. What
the file says besides is kept: of a cuboid in FrameLabels.extra, of the drive in DriveLabels.extra.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.classes import class_name
from lidar_perception.data.frame import Frame
from lidar_perception.data.kitti.labels import COLUMNS, DONT_CARE
from lidar_perception.labels.drive_labels import (
    NO_TRACK,
    DriveLabels,
    FrameLabels,
    Row,
    of_rows,
    unchanged,
)
from lidar_perception.labels.formats import openlabel_parts as parts
from lidar_perception.labels.formats.files import (
    in_file,
    is_number,
    known_drive_files,
    read_json,
    sequences_of,
    track_names,
    track_numbers,
    write_drives,
    write_json,
)
from lidar_perception.types import InputError

SUFFIX, ROOT = ".json", "openlabel"
# Attributes of a cuboid, and names in FrameLabels.extra: what is no plain value of a cuboid, or of
# its object; a cuboid that is kept as it is while nobody moves it.
SCORE, TRACKED, TYPE = "confidence", "tracked", "type"
UID, OTHER, OBJECT = "uid", "openlabel_attributes", "openlabel_data"
REGION = "openlabel_region"  # data of an object whose 2D boxes are notes with KITTI's columns
REGION_CLASS = "DontCare"
PROPERTIES = "frame_properties"
KEPT, DATA, CUBOIDS = "openlabel_cuboid", "object_data", "cuboid"


def read(path: Path, frames: Sequence[Frame]) -> DriveLabels:
    """path: one JSON file, or a folder with DRIVE.json of each drive."""
    files = known_drive_files(path, frames, SUFFIX)
    labels: list[FrameLabels] = []
    extra = {}
    for drive, positions in sequences_of(frames).items():
        own = [frames[i] for i in positions]
        if drive not in files:
            labels += [of_rows(frame, ()) for frame in own]
            continue
        where = str(files[drive])
        found, extra[drive] = in_file(where, partial(_read_drive, files[drive], own, where))
        labels += found
    return DriveLabels(labels, {ROOT: extra})


def _read_drive(path: Path, frames: list[Frame],
                where: str) -> tuple[list[FrameLabels], dict[str, Any]]:
    """The labels, and what else the file says."""
    content = dict(read_json(path)[ROOT])
    objects, systems = content.get("objects", {}), content.get("coordinate_systems", {})
    said = content.get("frames", {})
    if strange := sorted(set(said) - {str(frame.index) for frame in frames}):
        raise InputError(f"{where} has the frame {strange[0]!r} ({len(strange)} such), and the "
                         f"drive has {frames[0].index} to {frames[-1].index}; give the drive that "
                         "was labelled")
    numbers = track_numbers([*objects, *(uid for frame in said.values()
                                         for uid in frame.get("objects", {}))])
    found = []
    for frame in frames:
        here = said.get(str(frame.index), {})
        rows: list[Row] = []
        notes: list[tuple[str, dict[str, Any]]] = []
        for uid, element in here.get("objects", {}).items():
            data = dict(element.get(DATA, {}))
            kind = class_name(str(objects.get(uid, {}).get("type", "")))
            named_so = {} if str(numbers[uid]) == uid else {UID: uid}
            cuboids = [cuboid for cuboid in data.get(CUBOIDS, ())
                       if kind != REGION_CLASS and parts.has_size(cuboid)]
            if not cuboids:
                notes += _regions(kind, uid, data)
                continue
            data[CUBOIDS] = [cuboid for cuboid in data[CUBOIDS] if cuboid not in cuboids]
            data = {key: items for key, items in data.items() if items}
            for k, cuboid in enumerate(cuboids):
                system = cuboid.get("coordinate_system", "")
                box, upright = parts.box_of(cuboid["val"], parts.to_lidar(
                    system, systems, here, frame, where))
                rows.append((box, *_known(cuboid, kind, numbers[uid]),
                             {**named_so, **({OBJECT: data} if data and k == 0 else {}),
                              **_rest(cuboid, box, upright and system in (
                                  "", parts.lidar_of(systems, where)))}))
        found.append(of_rows(frame, rows, notes, f"{where}, frame {frame.index}"))
    return found, {**content, "frames": {
        number: {**{key: value for key, value in frame.items() if key != "objects"},
                 PROPERTIES: dict(frame.get(PROPERTIES, {}))}
        for number, frame in said.items()}}


def _regions(kind: str, uid: str, data: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """Notes of an object without a box: for each of its 2D boxes one that KITTI has a line for,
    of which the first holds the data; without a 2D box one of the data."""
    values, rest = parts.from_named(data)
    columns = {name: DONT_CARE[name] for name in COLUMNS if name in DONT_CARE}
    notes = [(kind, {**columns, **values, "bbox": box, UID: uid, REGION: {} if k else data})
             for k, box in enumerate(parts.regions_of(data))]
    return notes or [(kind, {**values, **({OBJECT: rest} if rest else {}),
                             **({} if values else {UID: uid})})]


def _known(cuboid: dict[str, Any], kind: str, number: int) -> tuple[str, int, float]:
    """Class, track id and score."""
    values, _ = parts.from_named(cuboid.get("attributes", {}))
    return (class_name(values.get(TYPE, kind)), number if values.get(TRACKED, True) else NO_TRACK,
            values.get(SCORE, np.nan))


def _rest(cuboid: dict[str, Any], box: list[float], plain: bool) -> dict[str, Any]:
    """extra of a cuboid. plain: its box says all of it."""
    values, rest = parts.from_named(cuboid.get("attributes", {}))
    extra = {name: v for name, v in values.items() if name not in (SCORE, TRACKED, TYPE)}
    extra |= {OTHER: rest} if rest else {}
    if not plain or set(cuboid) - {"val", "attributes", "name", "coordinate_system"}:
        extra[KEPT] = {**{k: v for k, v in cuboid.items() if k != "attributes"}, "box": box}
    return extra


def write(labels: DriveLabels, out: Path, frames: Sequence[Frame], force: bool = False) -> None:
    """out: FILE.json, or a folder for a file of each drive. Numbers are exact."""
    kept = labels.extra.get(ROOT, {})

    def write_drive(file: Path, drive: str, positions: list[int]) -> None:
        write_json(file, _content(labels, frames, positions, kept.get(drive, {})))

    write_drives(out, frames, SUFFIX, force, write_drive)


def _content(labels: DriveLabels, frames: Sequence[Frame], positions: Sequence[int],
             kept: dict[str, Any]) -> dict[str, Any]:
    """kept: what was read from such a file, but for its boxes."""
    own = [(frames[i], labels.frames[i]) for i in positions]
    named_tracks = track_names((each for _, each in own), UID)
    used = {str(i) for _, each in own for i in each.track_ids.tolist()} | {
        *named_tracks.values(), *(str(note[UID]) for _, each in own for _, note in each.notes
                                  if UID in note)}
    objects = {uid: dict(o) for uid, o in kept.get("objects", {}).items()  # used, or of no frame
               if uid in used or not o.get("frame_intervals")}
    systems = kept if kept.get("coordinate_systems") else parts.coordinate_systems(
        [frame for frame, _ in own])
    lidar = parts.lidar_of(systems["coordinate_systems"], "the file that was read")
    new = itertools.count(max([0, *(int(u) for u in [*used, *objects] if is_number(u))]) + 1)
    said: dict[str, Any] = {}
    seen: dict[str, list[int]] = {}

    def element(uid: str, kind: str, index: int) -> dict[str, Any]:
        """The object of this frame."""
        if uid not in seen:
            before = objects.get(uid, {})
            same = class_name(str(before.get("type", ""))) == kind  # in any spelling
            objects[uid] = {"name": f"{kind} {uid}", **before,
                            "type": before["type"] if same else kind}
        seen.setdefault(uid, []).append(index)
        return said[str(index)].setdefault("objects", {}).setdefault(uid, {DATA: {}})[DATA]

    for frame, each in own:
        before = kept.get("frames", {}).get(str(frame.index), {})
        said[str(frame.index)] = {**before, PROPERTIES: {
            **({} if systems is kept else parts.transforms(frame)),
            **before.get(PROPERTIES, {}), "name": frame.name,
            "timestamp": f"{frame.stamp_ns / 1e9:.9f}"}}
        for k, (kind, extra) in enumerate(zip(each.class_names, each.extra)):
            track = int(each.track_ids[k])
            uid = named_tracks.get(track, str(next(new) if track == NO_TRACK else track))
            data = element(uid, kind, frame.index)
            data |= {key: value for key, value in extra.get(OBJECT, {}).items() if key not in data}
            data.setdefault(CUBOIDS, []).append(_cuboid(each, k, objects[uid]["type"], lidar))
        for kind, note in each.notes:
            values = {key: value for key, value in note.items() if key not in (UID, OBJECT)}
            element(str(note.get(UID, next(new))), kind, frame.index).update(
                note[REGION] if REGION in note else
                {**parts.named(values), **note.get(OBJECT, {})})
    for uid, numbers in seen.items():
        objects[uid]["frame_intervals"] = parts.intervals(numbers)
    return {ROOT: {"metadata": {"schema_version": "1.0.0"}, **kept, **systems, "frames": said,
                   "objects": objects,
                   "frame_intervals": parts.intervals([frame.index for frame, _ in own])}}


def _cuboid(labels: FrameLabels, k: int, kind: str, lidar: str) -> dict[str, Any]:
    box, extra = labels.boxes[k], labels.extra[k]
    x, y, z, length, width, height, yaw = box.tolist()
    cuboid = {"name": "box", "coordinate_system": lidar,
              "val": [x, y, z, *parts.quaternion(yaw), length, width, height]}
    if KEPT in extra and unchanged(box, extra[KEPT]["box"]):
        cuboid = {key: value for key, value in extra[KEPT].items() if key != "box"}
    values = {name: v for name, v in extra.items() if name not in (UID, OTHER, OBJECT, KEPT)}
    values |= {SCORE: float(labels.scores[k])} if np.isfinite(labels.scores[k]) else {}
    values |= {TRACKED: False} if labels.track_ids[k] == NO_TRACK else {}
    values |= {TYPE: labels.class_names[k]} if labels.class_names[k] != class_name(kind) else {}
    attributes = parts.named(values)
    for name, items in extra.get(OTHER, {}).items():
        attributes.setdefault(name, []).extend(items)
    return {**cuboid, **({"attributes": attributes} if attributes else {})}
