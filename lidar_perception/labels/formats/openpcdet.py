"""Labels of OpenPCDet's custom data: one text file a frame, see data.openpcdet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from lidar_perception.data.frame import Frame
from lidar_perception.data.openpcdet import read_labels
from lidar_perception.labels.drive_labels import DriveLabels, of_truth
from lidar_perception.labels.formats.files import check_all_known, frame_files


def read(path: Path, frames: Sequence[Frame]) -> DriveLabels:
    """Read a folder with FRAME.txt, or with labels/FRAME.txt. A frame without a file has no
    labels."""
    path = path / "labels" if (path / "labels").is_dir() else path
    files = frame_files(path, frames, ".txt")
    check_all_known(path, files, ".txt")
    return DriveLabels([of_truth(replace(frame, truth=partial(read_labels, file)))
                        for frame, file in zip(frames, files)])
