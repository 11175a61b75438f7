"""Labels of OpenPCDet's custom data: one text file per frame, see data.openpcdet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from lidar_perception.data.frame import Frame
from lidar_perception.data.openpcdet import read_labels
from lidar_perception.labels.drive_labels import DriveLabels, read_frame_labels
from lidar_perception.labels.formats.files import check_label_files, list_frame_files


def read(path: Path, frames: Sequence[Frame]) -> DriveLabels:
    """Read a folder with files FRAME.txt or labels/FRAME.txt.

    Frames without a file have no labels.
    """
    path = path / "labels" if (path / "labels").is_dir() else path
    files = list_frame_files(path, frames, ".txt")
    check_label_files(path, files, ".txt")
    return DriveLabels(
        [read_frame_labels(replace(frame, truth=partial(read_labels, file))) for frame, file in zip(frames, files)]
    )
