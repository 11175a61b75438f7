"""Labels in and out: which format lies there, and one way to read and to write each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from lidar_perception.data.frame import Frame
from lidar_perception.labeling.formats import (
    bag,
    kitti_object,
    kitti_tracking,
    labelcloud,
    nuscenes,
    openlabel,
    sustech,
)
from lidar_perception.labeling.labels import DriveLabels
from lidar_perception.types import InputError

Read = Callable[[Path, Sequence[Frame]], DriveLabels]
Write = Callable[..., None]  # labels, out, frames, force

# Each reads the labels of a drive's frames at a path, and writes them to one, with force over what
# is there. A new format is a file and a line here.
FORMATS: dict[str, tuple[Read, Write]] = {
    "kitti_object": (kitti_object.read, kitti_object.write),
    "kitti_tracking": (kitti_tracking.read, kitti_tracking.write),
    "nuscenes_detection": nuscenes.detection,
    "nuscenes_tracking": nuscenes.tracking,
    "labelcloud": labelcloud.absolute,
    "labelcloud_rel": labelcloud.relative,
    "labelcloud_vertices": labelcloud.vertices,
    "sustech": (sustech.read, sustech.write),
    "openlabel": (openlabel.read, openlabel.write),
    "bag": (bag.read, bag.write),
    "bag_labels": (bag.read, bag.write_labels),
}


@dataclass(frozen=True)
class Written:
    """What was written where: how many boxes of how many frames."""

    path: Path
    boxes: int
    frames: int


def import_labels(path: Path, format: str, frames: Sequence[Frame]) -> DriveLabels:
    """The labels at a path, of each of the frames of a drive in their order. InputError in one line
    where they cannot be read, or are of frames that the drive has not."""
    return _of(format)[0](path, frames)


def export_labels(labels: DriveLabels, format: str, out: Path, frames: Sequence[Frame],
                  force: bool = False) -> Written:
    """Write the labels of the frames of a drive. InputError in one line where they cannot be
    written; then nothing is half-written. What exists is replaced with force only."""
    if len(labels) != len(frames):
        raise InputError(f"labels of {len(labels)} frames for a drive of {len(frames)}; give those "
                         "of the same frames")
    _of(format)[1](labels, out, frames, force)
    return Written(out, labels.boxes, len(labels))


def _of(format: str) -> tuple[Read, Write]:
    if format not in FORMATS:
        raise InputError(f"there is no format {format!r} for labels; there are "
                         f"{', '.join(FORMATS)}")
    return FORMATS[format]
