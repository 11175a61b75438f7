"""labelCloud's JSON files, one per frame: each box has a centroid and rotations, or eight vertices.

Rotations are about z, then the rotated y, then the rotated x, in degrees from 0 to 360
(centroid_abs) or in radians from -pi to pi (centroid_rel). The length is along the rotated x axis.
Vertices start at the rear right corner of the bottom face and continue with the rear left one; the
top face follows in the same order (seen along y as in labelCloud's manual). Numbers have eight
decimals, as in labelCloud. labelCloud reads the classes and the format from _classes.json in the
same folder, and drops unknown fields when it saves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.data.frame import Frame
from lidar_perception.geometry import box_corners
from lidar_perception.labels.drive_labels import (
    NO_TRACK,
    DriveLabels,
    FrameLabels,
    Row,
    get_id_and_score,
    is_unchanged,
    make_frame_labels,
)
from lidar_perception.labels.formats.files import (
    check_label_files,
    extract_extra,
    list_frame_files,
    merge_extra,
    read_json,
    report_format_errors,
    write_json,
)
from lidar_perception.runs.files import write_folder
from msg_utils.markers import COLORS, OTHER_COLOR

ROOT, CLASSES_FILE, SUFFIX = "labelcloud", "_classes.json", ".json"
DECIMALS = 8
CORNERS = [2, 1, 0, 3, 6, 5, 4, 7]  # order of geometry.box_corners in labelCloud
ABSOLUTE, RELATIVE, VERTICES = NOTATIONS = "centroid_abs", "centroid_rel", "vertices"
TILTED = "labelcloud_tilted"
OWN_FIELDS = {"name", "centroid", "dimensions", "rotations", "vertices", "track_id", "score"}


def _read(notation: str, path: Path, frames: Sequence[Frame]) -> DriveLabels:
    """Read a folder with files FRAME.json. Frames without a file have no labels."""
    files = list_frame_files(path, frames, SUFFIX)
    check_label_files(path, files, SUFFIX, ignored=(CLASSES_FILE,))
    classes = path / CLASSES_FILE
    if classes.exists():  # this file states the format
        content = read_json(classes)
        stated_notation = content.get("format") if isinstance(content, dict) else None
        notation = stated_notation if stated_notation in NOTATIONS else notation
    labels, headers = [], {}
    for frame, file in zip(frames, files):
        content = read_json(file) if file.exists() else {"objects": []}
        with report_format_errors(file):
            labels.append(make_frame_labels(frame, _parse_objects(content, notation), source=file))
        if file.exists():
            headers[frame.name] = {k: v for k, v in content.items() if k != "objects"}
    return DriveLabels(labels, {ROOT: headers})


def _parse_objects(content: dict[str, Any], notation: str) -> list[Row]:
    rows: list[Row] = []
    for item in content["objects"]:
        extra = extract_extra(item, OWN_FIELDS)
        shape = {key: item[key] for key in ("rotations", "vertices") if key in item}
        box, is_tilted = _parse_box(item, notation)
        if is_tilted:
            extra[TILTED] = {**shape, "unit": notation, "box": box}
        rows.append(
            (box, str(item["name"]), int(item.get("track_id", NO_TRACK)), float(item.get("score", math.nan)), extra)
        )
    return rows


def _parse_box(item: dict[str, Any], notation: str) -> tuple[list[float], bool]:
    """Return a box [x y z l w h yaw], and True if the original box is tilted."""
    if "vertices" in item:
        corners = np.array(item["vertices"], float).reshape(8, 3)
        edges = np.array(
            [
                corners[3] - corners[0] + corners[2] - corners[1],
                corners[1] - corners[0] + corners[2] - corners[3],
                corners[4:].sum(axis=0) - corners[:4].sum(axis=0),
            ]
        )
        sides = np.linalg.norm(edges, axis=1) / [2, 2, 4]
        return (
            [*corners.mean(axis=0).tolist(), *sides.tolist(), math.atan2(edges[0, 1], edges[0, 0])],
            bool(np.abs([*edges[:2, 2], *edges[2, :2]]).max() > 1e-6),
        )
    angles = [item["rotations"][axis] for axis in "xyz"]
    x, y, z = angles if notation == RELATIVE else np.radians(angles).tolist()
    yaw = z if math.cos(y) > 0 else z + math.pi
    return (
        [item["centroid"][axis] for axis in "xyz"]
        + [item["dimensions"][side] for side in ("length", "width", "height")]
        + [math.remainder(yaw, 2 * math.pi)],
        abs(math.sin(x)) + abs(math.sin(y)) > 1e-9 or math.cos(x) * math.cos(y) < 0,
    )


def _write(notation: str, labels: DriveLabels, out: Path, frames: Sequence[Frame], force: bool = False) -> None:
    """Write FRAME.json for each frame, and _classes.json, to the folder `out`."""
    names = sorted({name for frame_labels in labels.frames for name in frame_labels.class_names})
    headers = labels.extra.get(ROOT, {})
    with write_folder(out, force) as folder:
        files = list_frame_files(folder, frames, SUFFIX)
        for frame_labels, frame, file in zip(labels.frames, frames, files):
            cloud = frame.points or Path(f"{file.stem}.pcd")
            objects = [_make_object(frame_labels, k, notation) for k in range(len(frame_labels))]
            write_json(
                file,
                {
                    "folder": cloud.parent.name,
                    "filename": cloud.name,
                    "path": str(cloud),
                    **headers.get(frame.name, {}),
                    "objects": objects,
                },
                1,
            )
        write_json(
            folder / CLASSES_FILE,
            {
                "classes": [{"name": name, "id": i, "color": _to_hex_color(name)} for i, name in enumerate(names)],
                "default": 0,
                "type": "object_detection",
                "format": notation,
                "created_with": {"name": "lidar_perception", "version": ""},
            },
            1,
        )


def _make_object(labels: FrameLabels, k: int, notation: str) -> dict[str, Any]:
    box, extra = labels.boxes[k], dict(labels.extra[k])
    x, y, z, length, width, height, _ = box.round(DECIMALS).tolist()
    original = extra.pop(TILTED, None)
    shape: dict[str, Any]
    if original and original["unit"] == notation and is_unchanged(box, original["box"]):
        shape = {key: original[key] for key in ("rotations", "vertices") if key in original}
    elif notation == VERTICES:
        shape = {"vertices": box_corners(box[None])[0][CORNERS].round(DECIMALS).tolist()}
    else:
        yaw = math.degrees(box[6]) % 360 if notation == ABSOLUTE else math.remainder(box[6], math.tau)
        yaw = round(yaw, DECIMALS)
        shape = {"rotations": {"x": 0, "y": 0, "z": yaw % 360 if notation == ABSOLUTE else yaw}}
    if notation != VERTICES:
        shape = {
            "centroid": {"x": x, "y": y, "z": z},
            "dimensions": {"length": length, "width": width, "height": height},
            **shape,
        }
    return {**merge_extra(extra, OWN_FIELDS), "name": labels.class_names[k], **shape, **get_id_and_score(labels, k)}


def _to_hex_color(name: str) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in COLORS.get(name, OTHER_COLOR))


absolute_format, relative_format, vertices_format = (
    (partial(_read, notation), partial(_write, notation)) for notation in NOTATIONS
)
