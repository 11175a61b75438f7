"""Tracklets of KITTI's raw drives, as CVAT and Datumaro export them: one XML file a drive.

data.kitti.labels.read_tracklets reads the boxes. frame_list.txt in the same folder gives the number
of each frame by its name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from lidar_perception.data.frame import Frame
from lidar_perception.data.kitti.labels import read_tracklets
from lidar_perception.data.kitti.raw import FRAME_LIST, TRACKLETS, read_frame_list
from lidar_perception.labels.drive_labels import DriveLabels, FrameLabels, of_rows, of_truth
from lidar_perception.labels.formats.files import sequences_of
from lidar_perception.types import InputError


def read(path: Path, frames: Sequence[Frame]) -> DriveLabels:
    """Read FILE.xml or a folder with tracklet_labels.xml; of several drives a folder with
    DRIVE/tracklet_labels.xml. A drive without a file has no labels."""
    drives = sequences_of(frames)
    if path.is_file() and len(drives) > 1:
        raise InputError(f"{path} is one file, and the frames are of {len(drives)} drives; give a "
                         "folder, or choose a drive with --split")
    labels: list[FrameLabels] = []
    found = False
    for drive, positions in drives.items():
        files = (path, path / TRACKLETS) if len(drives) == 1 else ()
        file = next((file for file in (*files, path / drive / TRACKLETS) if file.is_file()), None)
        found = found or file is not None
        own = [frames[i] for i in positions]
        labels += [of_rows(frame, ()) for frame in own] if file is None else _of_file(file, own)
    if not found:
        raise InputError(f"{path} has no {TRACKLETS}; give the folder that has it")
    return DriveLabels(labels)


def _of_file(path: Path, frames: Sequence[Frame]) -> list[FrameLabels]:
    names = path.with_name(FRAME_LIST)
    known = read_frame_list(names) if names.exists() else {}
    numbers = [known.get(frame.name.rpartition("/")[2], frame.index) for frame in frames]
    truth = read_tracklets(path)
    # Tracks go on over scans that are missing.
    if strange := sorted(n for n in truth if not min(numbers) <= n <= max(numbers)):
        raise InputError(f"{path} has the frame {strange[0]} ({len(strange)} such), and the drive "
                         f"has {min(numbers)} to {max(numbers)}; give the drive that was labelled")
    return [of_truth(replace(frame, truth=partial(truth.get, number)))
            for frame, number in zip(frames, numbers)]
