"""KITTI's tracking benchmark, label_02: one text file a drive, a line a box with the frame's number
and the track's id."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lidar_perception.data.frame import Frame
from lidar_perception.data.kitti.labels import parse_tracking_lines
from lidar_perception.data.kitti.write import format_tracking_line
from lidar_perception.labels.drive_labels import NO_TRACK, DriveLabels, FrameLabels
from lidar_perception.labels.formats.files import known_drive_files, sequences_of, write_drives
from lidar_perception.labels.formats.kitti_lines import frame_labels, label_folder, lines_of
from lidar_perception.runs.files import write_bytes
from lidar_perception.types import InputError


def read(path: Path, frames: Sequence[Frame]) -> DriveLabels:
    """path: DRIVE.txt, a folder of them, or a folder of the tracking layout."""
    path = label_folder(path, "label_02")
    files = known_drive_files(path, frames, ".txt")
    labels: list[FrameLabels] = []
    for drive, positions in sequences_of(frames).items():
        lines: dict[int, list[dict[str, Any]]] = {frames[i].index: [] for i in positions}
        if drive in files:
            for number, frame, line in parse_tracking_lines(files[drive]):
                if frame not in lines:
                    raise InputError(f"{files[drive]}:{number} is of frame {frame}, and the drive "
                                     f"has {min(lines)} to {max(lines)} ({len(lines)} of them); "
                                     "give the drive that was labelled")
                lines[frame].append({**line, "truncated": round(line["truncated"])})
        labels += [frame_labels(frames[i], lines[frames[i].index],
                                f"{files.get(drive)}, frame {frames[i].index}") for i in positions]
    return DriveLabels(labels)


def write(labels: DriveLabels, out: Path, frames: Sequence[Frame], force: bool = False) -> None:
    """out: DRIVE.txt, or a folder for a file of each drive. Numbers have six decimals."""
    def write_drive(file: Path, drive: str, positions: list[int]) -> None:
        write_bytes(file, "".join(text_of_frame(labels.frames[i], frames[i], frames[i].index)
                                  for i in positions).encode())

    write_drives(out, frames, ".txt", force, write_drive)


def text_of_frame(labels: FrameLabels, frame: Frame, number: int) -> str:
    """The lines of a frame under this number."""
    return "".join(format_tracking_line(number, line.get("track_id", NO_TRACK), line)
                   for line in lines_of(labels, frame, levels=True))
