"""KITTI's object benchmark, label_2: one text file per frame, without track ids."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from lidar_perception.data.frame import Frame
from lidar_perception.data.kitti.labels import format_label, parse_lines
from lidar_perception.labels.drive_labels import DriveLabels, FrameLabels
from lidar_perception.labels.formats.files import check_label_files, list_frame_files
from lidar_perception.labels.formats.kitti_lines import find_label_folder, make_lines, parse_frame_labels
from lidar_perception.runs.files import write_bytes, write_folder

# Trailing zeros after the second decimal. KITTI's files have two decimals; computed numbers have up to six.
TRAILING_ZEROS = re.compile(r"(\.\d\d\d*?)0+(?=\s|$)")


def read(path: Path, frames: Sequence[Frame]) -> DriveLabels:
    """Read a folder with files FRAME.txt, or a folder with the object layout.

    Frames without a file have no labels.
    """
    path = find_label_folder(path, "label_2")
    files = list_frame_files(path, frames, ".txt")
    check_label_files(path, files, ".txt")
    return DriveLabels(
        [
            parse_frame_labels(frame, [line for _, line in parse_lines(file)] if file.exists() else [], file)
            for frame, file in zip(frames, files)
        ]
    )


def write(labels: DriveLabels, out: Path, frames: Sequence[Frame], force: bool = False) -> None:
    """Write one file per frame to the folder `out`."""
    with write_folder(out, force) as folder:
        files = list_frame_files(folder, frames, ".txt")
        for frame_labels, frame, file in zip(labels.frames, frames, files):
            write_bytes(file, format_frame(frame_labels, frame).encode())


def format_frame(labels: FrameLabels, frame: Frame) -> str:
    """Format the labels of a frame as the lines of its file."""
    return "".join(
        TRAILING_ZEROS.sub(r"\1", format_label(line, 6)) + "\n" for line in make_lines(labels, frame, levels=False)
    )
