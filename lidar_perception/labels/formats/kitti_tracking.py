"""KITTI's tracking benchmark, label_02: one text file per drive, with frame numbers and track ids."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lidar_perception.data.frame import Frame
from lidar_perception.data.kitti.labels import parse_tracking_lines
from lidar_perception.data.kitti.write import format_tracking_line
from lidar_perception.labels.drive_labels import NO_TRACK, DriveLabels, FrameLabels
from lidar_perception.labels.formats.files import find_drive_files, group_by_sequence, write_drives
from lidar_perception.labels.formats.kitti_lines import find_label_folder, make_lines, parse_frame_labels
from lidar_perception.runs.files import write_bytes
from lidar_perception.types import InputError


def read(path: Path, frames: Sequence[Frame]) -> DriveLabels:
    """Read DRIVE.txt, a folder of such files, or a folder with the tracking layout."""
    path = find_label_folder(path, "label_02")
    files = find_drive_files(path, frames, ".txt")
    labels: list[FrameLabels] = []
    for drive, positions in group_by_sequence(frames).items():
        lines: dict[int, list[dict[str, Any]]] = {frames[i].index: [] for i in positions}
        if drive in files:
            for number, frame, line in parse_tracking_lines(files[drive]):
                if frame not in lines:
                    raise InputError(
                        f"{files[drive]}:{number} is a label of frame {frame}, but the "
                        f"drive has frames {min(lines)} to {max(lines)}; give the drive "
                        "that was labelled"
                    )
                lines[frame].append({**line, "truncated": round(line["truncated"])})
        labels += [
            parse_frame_labels(frames[i], lines[frames[i].index], f"{files.get(drive)}, frame {frames[i].index}")
            for i in positions
        ]
    return DriveLabels(labels)


def write(labels: DriveLabels, out: Path, frames: Sequence[Frame], force: bool = False) -> None:
    """Write DRIVE.txt, or a folder with one file per drive; numbers have six decimals."""

    def write_drive(file: Path, drive: str, positions: list[int]) -> None:
        write_bytes(
            file, "".join(format_frame(labels.frames[i], frames[i], frames[i].index) for i in positions).encode()
        )

    write_drives(out, frames, ".txt", force, write_drive)


def format_frame(labels: FrameLabels, frame: Frame, number: int) -> str:
    """Format the labels of a frame as lines that start with the frame number."""
    return "".join(
        format_tracking_line(number, line.get("track_id", NO_TRACK), line)
        for line in make_lines(labels, frame, levels=True)
    )
