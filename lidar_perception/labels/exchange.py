"""Import and export of labels in all formats, and recognition of the format of a file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.data.bag_frames import can_open as is_bag
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
from lidar_perception.labels.formats.files import MAX_BYTES, read_json, report_format_errors
from lidar_perception.labels.formats.kitti_lines import find_label_folder
from lidar_perception.labels.names import resolve_format
from lidar_perception.runs.files import read_text
from lidar_perception.types import InputError

Reader = Callable[[Path, Sequence[Frame]], DriveLabels]
Writer = Callable[..., None]  # arguments: labels, out, frames, force

# Reader and writer of each format; with `force`, a writer replaces existing files. To add a format,
# add a module with both functions, and a line here.
FORMATS: dict[str, tuple[Reader, Writer]] = {
    "kitti": (kitti_object.read, kitti_object.write),
    "kitti-tracking": (kitti_tracking.read, kitti_tracking.write),
    "nuscenes-detection": nuscenes.detection_format,
    "nuscenes-tracking": nuscenes.tracking_format,
    "labelcloud": labelcloud.absolute_format,
    "labelcloud-rel": labelcloud.relative_format,
    "labelcloud-vertices": labelcloud.vertices_format,
    "sustech": (sustech.read, sustech.write),
    "openlabel": (openlabel.read, openlabel.write),
    "mcap": (bag.read, bag.write),
    "mcap-labels": (bag.read, partial(bag.write, clouds=False)),
}
# Readers of these formats and of formats that cannot be written.
READERS: dict[str, Reader] = {name: read for name, (read, _) in FORMATS.items()} | {
    "kitti-raw": kitti_raw.read,
    "openpcdet": openpcdet.read,
}
FORMATS_WITH_NOTES = {"kitti", "kitti-tracking", "openlabel", "mcap", "mcap-labels"}


@dataclass(frozen=True)
class ExportResult:
    """Result of an export: number of boxes and frames, and descriptions of omitted content."""

    path: Path
    boxes: int
    frames: int
    left_out: tuple[str, ...] = ()


def import_labels(path: Path, format: str, frames: Sequence[Frame]) -> DriveLabels:
    """Read the labels at a path for each frame of a drive.

    Raises:
        InputError: The labels cannot be read, or belong to frames that are not in the drive.
    """
    with np.errstate(all="ignore"):  # FrameLabels.of rejects numbers that overflow
        read = READERS[resolve_format(format, READERS)]
        return read(path, frames[:])  # the frames in a slice of a bag do not hold their clouds


def export_labels(
    labels: DriveLabels, format: str, out: Path, frames: Sequence[Frame], force: bool = False
) -> ExportResult:
    """Write the labels of a drive; existing files are replaced only with `force`.

    Raises:
        InputError: The labels cannot be written; no files remain.
    """
    format = resolve_format(format, FORMATS)
    if len(labels) != len(frames):
        raise InputError(
            f"the labels have {len(labels)} frames, but the drive has {len(frames)}; give the labels of this drive"
        )
    with report_format_errors("a preserved field of the file that the labels were read from"):
        FORMATS[format][1](labels, out, frames[:], force)
    notes = 0 if format in FORMATS_WITH_NOTES else sum(len(frame_labels.notes) for frame_labels in labels.frames)
    has_ids = format == "kitti" and any((f.track_ids != NO_TRACK).any() for f in labels.frames)
    return ExportResult(
        out,
        labels.box_count,
        len(labels),
        (*((f"{notes} regions without a box",) if notes else ()), *(("track ids",) if has_ids else ())),
    )


def recognise_format(path: Path) -> str:
    """Recognise the format of the labels at a path. Raise InputError if it is unknown."""
    files = (
        [path]
        if path.is_file()
        else sorted(
            file
            for file in path.rglob("*")
            if file.suffix in (".txt", ".json") and not file.name.startswith(("_", "."))
        )
    )
    if not path.exists():
        raise InputError(
            f"{path} does not exist; give a file or folder with labels in one of the formats {', '.join(READERS)}"
        )
    if path.suffix in (".mcap", ".db3") or (path.is_dir() and is_bag(path)):
        return "mcap"
    if path.suffix == ".xml" or any(path.glob(f"**/{TRACKLETS}")):
        return "kitti-raw"
    for folder, format in ("label_02", "kitti-tracking"), ("label_2", "kitti"):
        if find_label_folder(path, folder) != path:
            return format
    for file in files:
        if format := _recognise_text(file) if file.suffix == ".txt" else _recognise_json(read_json(file)):
            return format
    raise InputError(f"cannot recognise the label format of {path}; set it with --from to one of {', '.join(READERS)}")


def _recognise_text(file: Path) -> str:
    """Recognise a text format by the number of columns before the class name in the first line.

    Returns "" for other text files.
    """
    words = read_text(file, MAX_BYTES).lstrip().partition("\n")[0].split()
    if words and words[0].endswith(":"):
        return ""  # the file is a calibration
    numbers = 0
    with suppress(ValueError):
        for word in words:
            float(word)
            numbers += 1
    if numbers == 0:
        return "kitti" if len(words) > 3 else ""
    return "kitti-tracking" if numbers == 2 else "openpcdet" if numbers == 7 else ""


def _recognise_json(content: Any) -> str:
    """Recognise a JSON format by its keys; return "" for other JSON files and files without boxes."""
    with suppress(TypeError, LookupError, AttributeError):  # values may be of any type
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
