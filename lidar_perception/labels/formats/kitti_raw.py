"""Tracklets of KITTI's raw drives, also exported by CVAT and Datumaro: one XML file per drive.

frame_list.txt in the same folder maps the names of frames to their numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from lidar_perception.data.frame import Frame
from lidar_perception.data.kitti.labels import read_tracklets
from lidar_perception.data.kitti.raw import FRAME_LIST, TRACKLETS, read_frame_list
from lidar_perception.labels.drive_labels import DriveLabels, FrameLabels, make_frame_labels, read_frame_labels
from lidar_perception.labels.formats.files import group_by_sequence
from lidar_perception.types import InputError


def read(path: Path, frames: Sequence[Frame]) -> DriveLabels:
    """Read FILE.xml, or a folder with tracklet_labels.xml or DRIVE/tracklet_labels.xml.

    Drives without a file have no labels.
    """
    drives = group_by_sequence(frames)
    if path.is_file() and len(drives) > 1:
        raise InputError(
            f"{path} is a single file, but the frames belong to {len(drives)} drives; give "
            "a folder, or choose a drive with --split"
        )
    labels: list[FrameLabels] = []
    has_file = False
    for drive, positions in drives.items():
        files = (path, path / TRACKLETS) if len(drives) == 1 else ()
        file = next((file for file in (*files, path / drive / TRACKLETS) if file.is_file()), None)
        has_file = has_file or file is not None
        drive_frames = [frames[i] for i in positions]
        labels += (
            [make_frame_labels(frame, ()) for frame in drive_frames]
            if file is None
            else _read_drive(file, drive_frames)
        )
    if not has_file:
        raise InputError(f"{path} has no {TRACKLETS}; give the folder that contains it")
    return DriveLabels(labels)


def _read_drive(path: Path, frames: Sequence[Frame]) -> list[FrameLabels]:
    frame_list = path.with_name(FRAME_LIST)
    numbers_by_name = read_frame_list(frame_list) if frame_list.exists() else {}
    numbers = [numbers_by_name.get(frame.name.rpartition("/")[2], frame.index) for frame in frames]
    truth = read_tracklets(path)
    # Tracks continue over missing scans, so any number between the first and last frame is allowed.
    if unknown_numbers := sorted(n for n in truth if not min(numbers) <= n <= max(numbers)):
        raise InputError(
            f"{path} has labels of frame {unknown_numbers[0]} ({len(unknown_numbers)} unknown frames), but "
            f"the drive has frames {min(numbers)} to {max(numbers)}; give the drive that was "
            "labelled"
        )
    return [
        read_frame_labels(replace(frame, truth=partial(truth.get, number))) for frame, number in zip(frames, numbers)
    ]
