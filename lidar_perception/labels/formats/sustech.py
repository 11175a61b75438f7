"""SUSTechPOINTS' JSON files, one per frame: position, scale and rotation of each box.

scale.x is the length of the box, which points forward at rotation 0. Rotations are in radians,
about x, then the rotated y, then the rotated z, in the LiDAR frame. Ids are text. Numbers are
stored without rounding. SUSTechPOINTS drops unknown fields when it saves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lidar_perception.data.frame import Frame
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
    assign_track_ids,
    check_label_files,
    collect_track_names,
    extract_extra,
    list_frame_files,
    merge_extra,
    read_json,
    report_format_errors,
    write_json,
)
from lidar_perception.runs.files import write_folder

SUFFIX = ".json"
TILTED = "sustech_tilted"
OWN_FIELDS = {"psr", "obj_type", "obj_id", "score"}


def read(path: Path, frames: Sequence[Frame]) -> DriveLabels:
    """Read a folder with files FRAME.json or label/FRAME.json.

    Frames without a file have no labels.
    """
    path = path / "label" if (path / "label").is_dir() else path
    files = list_frame_files(path, frames, SUFFIX)
    check_label_files(path, files, SUFFIX)
    contents = []
    for file in files:
        content = read_json(file) if file.exists() else []
        # Later versions of SUSTechPOINTS wrap the list in an object.
        contents.append(content.get("objs", content) if isinstance(content, dict) else content)
    with report_format_errors(path):
        ids = assign_track_ids({str(item.get("obj_id", "")) for content in contents for item in content} - {""})
    labels = []
    for frame, file, content in zip(frames, files, contents):
        with report_format_errors(file):
            labels.append(make_frame_labels(frame, _parse_boxes(content, ids), source=file))
    return DriveLabels(labels)


def _parse_boxes(content: list[dict[str, Any]], ids: dict[str, int]) -> list[Row]:
    rows: list[Row] = []
    for item in content:
        position, scale, angles = (
            [float(item["psr"][part][axis]) for axis in "xyz"] for part in ("position", "scale", "rotation")
        )
        x, y, z = angles
        is_upright = x == y == 0
        yaw = (
            z
            if is_upright
            else math.atan2(
                math.cos(x) * math.sin(z) + math.sin(x) * math.sin(y) * math.cos(z), math.cos(y) * math.cos(z)
            )
        )
        box = [*position, *scale, math.remainder(yaw, math.tau)]
        extra = extract_extra(item, OWN_FIELDS)
        if not is_upright:
            extra[TILTED] = {"rotation": item["psr"]["rotation"], "box": box}
        name = str(item.get("obj_id", ""))
        track = ids.get(name, NO_TRACK)
        if name and name != str(track):
            extra["obj_id"] = name
        rows.append((box, str(item.get("obj_type", "")), track, float(item.get("score", math.nan)), extra))
    return rows


def write(labels: DriveLabels, out: Path, frames: Sequence[Frame], force: bool = False) -> None:
    """Write FRAME.json for each frame to the folder `out`."""
    names = collect_track_names(labels.frames, "obj_id")
    with write_folder(out, force) as folder:
        files = list_frame_files(folder, frames, SUFFIX)
        for frame_labels, file in zip(labels.frames, files):
            write_json(file, [_make_object(frame_labels, k, names) for k in range(len(frame_labels))], 1)


def _make_object(labels: FrameLabels, k: int, names: dict[int, str]) -> dict[str, Any]:
    box, extra = labels.boxes[k], dict(labels.extra[k])
    fields = get_id_and_score(labels, k)
    original, _ = extra.pop(TILTED, None), extra.pop("obj_id", None)
    track = fields.pop("track_id", "")
    rotation = {"x": 0, "y": 0, "z": float(box[6])}
    if original and is_unchanged(box, original["box"]):
        rotation = original["rotation"]
    psr = {
        "position": dict(zip("xyz", box[:3].tolist())),
        "scale": dict(zip("xyz", box[3:6].tolist())),
        "rotation": rotation,
    }
    return {
        **merge_extra(extra, OWN_FIELDS),
        "psr": psr,
        "obj_type": labels.class_names[k],
        "obj_id": names.get(track, str(track)),
        **fields,
    }
