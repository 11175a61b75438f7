"""SUSTechPOINTS' JSON files, one a frame: position, scale and rotation of each box.

scale.x is along the length, which points to the front at rotation 0; rotations are in radians,
about x, then the turned y, then the turned z, in the LiDAR's frame. Ids are text. Numbers are
exact. SUSTechPOINTS forgets fields that are not its own when it saves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from lidar_perception.data.frame import Frame
from lidar_perception.labels.drive_labels import (
    NO_TRACK,
    DriveLabels,
    FrameLabels,
    Row,
    ids_and_score,
    of_rows,
    unchanged,
)
from lidar_perception.labels.formats.files import (
    beside,
    check_all_known,
    extra_of,
    frame_files,
    in_file,
    read_json,
    track_names,
    track_numbers,
    write_json,
)
from lidar_perception.runs.files import write_folder

SUFFIX = ".json"
TILTED = "sustech_tilted"
OWN = {"psr", "obj_type", "obj_id", "score"}


def read(path: Path, frames: Sequence[Frame]) -> DriveLabels:
    """path: a folder with FRAME.json, or that of a scene with label/. A frame without a file has no
    labels."""
    path = path / "label" if (path / "label").is_dir() else path
    files = frame_files(path, frames, SUFFIX)
    check_all_known(path, files, SUFFIX)
    contents = []
    for file in files:
        content = read_json(file) if file.exists() else []
        # Later versions of the tool have the list inside of an object.
        contents.append(content.get("objs", content) if isinstance(content, dict) else content)
    ids = in_file(str(path), lambda: track_numbers({str(item.get("obj_id", ""))
                                                    for c in contents for item in c} - {""}))
    return DriveLabels([of_rows(frame, in_file(str(file), partial(_rows, content, ids)),
                                where=file)
                        for frame, file, content in zip(frames, files, contents)])


def _rows(content: list[dict[str, Any]], ids: dict[str, int]) -> list[Row]:
    rows: list[Row] = []
    for item in content:
        position, scale, turns = ([float(item["psr"][part][axis]) for axis in "xyz"]
                                  for part in ("position", "scale", "rotation"))
        x, y, z = turns
        upright = x == y == 0
        yaw = z if upright else math.atan2(
            math.cos(x) * math.sin(z) + math.sin(x) * math.sin(y) * math.cos(z),
            math.cos(y) * math.cos(z))
        box = [*position, *scale, math.remainder(yaw, math.tau)]
        extra = extra_of(item, OWN)
        if not upright:
            extra[TILTED] = {"rotation": item["psr"]["rotation"], "box": box}
        name = str(item.get("obj_id", ""))
        track = ids.get(name, NO_TRACK)
        if name and name != str(track):
            extra["obj_id"] = name
        rows.append((box, str(item.get("obj_type", "")), track,
                     float(item.get("score", math.nan)), extra))
    return rows


def write(labels: DriveLabels, out: Path, frames: Sequence[Frame], force: bool = False) -> None:
    """out: a folder, for FRAME.json of each frame."""
    names = track_names(labels.frames, "obj_id")
    with write_folder(out, force) as folder:
        for each, file in zip(labels.frames, frame_files(folder, frames, SUFFIX)):
            write_json(file, [_object(each, k, names) for k in range(len(each))], 1)


def _object(labels: FrameLabels, k: int, names: dict[int, str]) -> dict[str, Any]:
    box, extra = labels.boxes[k], dict(labels.extra[k])
    known = ids_and_score(labels, k)
    tilted, _ = extra.pop(TILTED, None), extra.pop("obj_id", None)
    track = known.pop("track_id", "")
    rotation = {"x": 0, "y": 0, "z": float(box[6])}
    if tilted and unchanged(box, tilted["box"]):
        rotation = tilted["rotation"]
    psr = {"position": dict(zip("xyz", box[:3].tolist())),
           "scale": dict(zip("xyz", box[3:6].tolist())), "rotation": rotation}
    return {**beside(extra, OWN), "psr": psr, "obj_type": labels.class_names[k],
            "obj_id": names.get(track, str(track)), **known}
