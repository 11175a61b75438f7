"""Labels in and out: which format lies there, and one way to read and to write each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.data.bag_frames import is_layout as is_bag
from lidar_perception.data.frame import Frame
from lidar_perception.data.kitti.raw import TRACKLETS
from lidar_perception.labels.drive_labels import NO_TRACK, DriveLabels
from lidar_perception.labels.formats import (
    bag,
    kitti_object,
    kitti_raw,
    kitti_tracking,
    labelcloud,
    nuscenes,
    openlabel,
    openpcdet,
    sustech,
)
from lidar_perception.labels.formats.files import MAX_BYTES, in_file, read_json
from lidar_perception.labels.formats.kitti_lines import label_folder
from lidar_perception.labels.names import format_name
from lidar_perception.runs.files import read_text
from lidar_perception.types import InputError

Read = Callable[[Path, Sequence[Frame]], DriveLabels]
Write = Callable[..., None]  # labels, out, frames, force

# Each reads the labels of a drive's frames at a path, and writes them to one, with force over what
# is there. A new format is a file and a line here.
FORMATS: dict[str, tuple[Read, Write]] = {
    "kitti": (kitti_object.read, kitti_object.write),
    "kitti-tracking": (kitti_tracking.read, kitti_tracking.write),
    "nuscenes-detection": nuscenes.detection,
    "nuscenes-tracking": nuscenes.tracking,
    "labelcloud": labelcloud.absolute,
    "labelcloud-rel": labelcloud.relative,
    "labelcloud-vertices": labelcloud.vertices,
    "sustech": (sustech.read, sustech.write),
    "openlabel": (openlabel.read, openlabel.write),
    "mcap": (bag.read, bag.write),
    "mcap-labels": (bag.read, bag.write_labels),
}
# What can be read: these, and formats that are not written.
READERS: dict[str, Read] = {name: read for name, (read, _) in FORMATS.items()} | {
    "kitti-raw": kitti_raw.read,
    "openpcdet": openpcdet.read,
}
WITH_NOTES = {"kitti", "kitti-tracking", "openlabel", "mcap", "mcap-labels"}


@dataclass(frozen=True)
class Written:
    """What was written where: how many boxes of how many frames; and what was left out, as the
    format has no place for it, in words."""

    path: Path
    boxes: int
    frames: int
    left_out: tuple[str, ...] = ()


def import_labels(path: Path, format: str, frames: Sequence[Frame]) -> DriveLabels:
    """The labels at a path, of each of the frames of a drive in their order. InputError in one line
    where they cannot be read, or are of frames that the drive has not."""
    with np.errstate(all="ignore"):  # what is too large for a float is no label, see FrameLabels.of
        read = READERS[format_name(format, READERS)]
        return read(path, frames[:])  # of a bag, frames that do not hold their clouds


def export_labels(labels: DriveLabels, format: str, out: Path, frames: Sequence[Frame],
                  force: bool = False) -> Written:
    """Write the labels of the frames of a drive. InputError in one line where they cannot be
    written; then nothing is half-written. What exists is replaced with force only."""
    format = format_name(format, FORMATS)
    if len(labels) != len(frames):
        raise InputError(f"labels of {len(labels)} frames for a drive of {len(frames)}; give those "
                         "of the same frames")
    in_file("what the labels keep of the file that they were read from",
            lambda: FORMATS[format][1](labels, out, frames[:], force))
    notes = 0 if format in WITH_NOTES else sum(len(each.notes) for each in labels.frames)
    ids = format == "kitti" and any((f.track_ids != NO_TRACK).any() for f in labels.frames)
    return Written(out, labels.boxes, len(labels), (
        *((f"{notes} regions without a box",) if notes else ()), *(("track ids",) if ids else ())))


def recognised(path: Path) -> str:
    """The format of the labels at a path. InputError if it is none of them, or cannot be told."""
    files = [path] if path.is_file() else sorted(
        file for file in path.rglob("*") if file.suffix in (".txt", ".json")
        and not file.name.startswith(("_", ".")))
    if not path.exists():
        raise InputError(f"there is no file or folder {path}; give one with labels: "
                         f"{', '.join(READERS)}")
    if path.suffix in (".mcap", ".db3") or (path.is_dir() and is_bag(path)):
        return "mcap"
    if path.suffix == ".xml" or any(path.glob(f"**/{TRACKLETS}")):
        return "kitti-raw"
    for folder, format in ("label_02", "kitti-tracking"), ("label_2", "kitti"):
        if label_folder(path, folder) != path:
            return format
    for file in files:
        found = _by_text(file) if file.suffix == ".txt" else _by_json(read_json(file))
        if found:
            return found
    raise InputError(f"{path} holds no labels that are recognised, or none at all; say with --from "
                     f"which of {', '.join(READERS)} they are")


def _by_text(file: Path) -> str:
    """Tell the format by how many numbers precede the class in the first line."""
    words = read_text(file, MAX_BYTES).lstrip().partition("\n")[0].split()
    if words and words[0].endswith(":"):
        return ""  # a calibration
    before = 0
    with suppress(ValueError):
        for word in words:
            float(word)
            before += 1
    if before == 0:
        return "kitti" if len(words) > 3 else ""
    return "kitti-tracking" if before == 2 else "openpcdet" if before == 7 else ""


def _by_json(content: Any) -> str:
    """By the keys; "" for a file without a box, such as of labelCloud and SUSTechPOINTS, and for
    one of something else, whose values may be of any kind."""
    with suppress(TypeError, LookupError, AttributeError):
        if isinstance(content, list) or "objs" in content:
            boxes = content if isinstance(content, list) else content["objs"]
            return "sustech" if "psr" in boxes[0] else ""
        if "openlabel" in content:
            return "openlabel"
        if "objects" in content:
            box = content["objects"][0]
            return "labelcloud" if "centroid" in box or "vertices" in box else ""
        for boxes in content["results"].values():
            for row in boxes:
                return "nuscenes-tracking" if "tracking_name" in row else "nuscenes-detection"
    return ""
