"""KITTI's object benchmark, label_2: one text file a frame, a line a box. It has no track ids."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from lidar_perception.data.frame import Frame
from lidar_perception.data.kitti.labels import format_label, parse_lines
from lidar_perception.labels.drive_labels import DriveLabels, FrameLabels
from lidar_perception.labels.formats.files import check_all_known, frame_files
from lidar_perception.labels.formats.kitti_lines import frame_labels, label_folder, lines_of
from lidar_perception.runs.files import write_bytes, write_folder

# KITTI's files have two decimals; what was computed has up to six.
ZEROS = re.compile(r"(\.\d\d\d*?)0+(?=\s|$)")


def read(path: Path, frames: Sequence[Frame]) -> DriveLabels:
    """path: a folder with FRAME.txt, or one of the object layout. A frame without a file has no
    labels."""
    path = label_folder(path, "label_2")
    files = frame_files(path, frames, ".txt")
    check_all_known(path, files, ".txt")
    return DriveLabels([frame_labels(
        frame, [line for _, line in parse_lines(file)] if file.exists() else [],
        file) for frame, file in zip(frames, files)])


def write(labels: DriveLabels, out: Path, frames: Sequence[Frame], force: bool = False) -> None:
    """out: a folder, for a file of each frame."""
    with write_folder(out, force) as folder:
        for each, frame, file in zip(labels.frames, frames, frame_files(folder, frames, ".txt")):
            write_bytes(file, text_of_frame(each, frame).encode())


def text_of_frame(labels: FrameLabels, frame: Frame) -> str:
    """The lines of a frame."""
    return "".join(ZEROS.sub(r"\1", format_label(line, 6)) + "\n"
                   for line in lines_of(labels, frame, levels=False))
