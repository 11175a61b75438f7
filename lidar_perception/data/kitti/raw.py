"""KITTI's raw drives, and drives that CVAT, Datumaro and Supervisely export in this layout: with
.pcd files, without time stamps and without calibration."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from lidar_perception.data.cloud_files import SUFFIXES, cloud_scale, is_cloud, load_points
from lidar_perception.data.frame import BOXES, CAMERA, Frame, Recording, nothing
from lidar_perception.data.kitti.calibration import RAW_CALIB, read_raw_calibration
from lidar_perception.data.kitti.folder import (
    GAP_NS,
    PERIOD_NS,
    START_NS,
    load_velodyne,
    number_of,
    truth_by_number,
)
from lidar_perception.data.kitti.labels import read_tracklets
from lidar_perception.runs.files import read_text
from lidar_perception.types import InputError, LidarFrame
from lidar_perception.wire.topics import LIDAR_FRAME

DATA = "velodyne_points/data"
TRACKLETS, FRAME_LIST = "tracklet_labels.xml", "frame_list.txt"


def recognises(path: Path) -> bool:
    """Return True for a drive, a day, and a folder of days."""
    return bool(drives_of(path))


def drives_of(path: Path) -> list[Path]:
    """List the drives at a path, in order."""
    return sorted(data.parents[1] for days in ("", "*/", "*/*/") for data in path.glob(days + DATA))


def open_recording(path: Path, *, points: str = "", scans: bool = True) -> Recording:
    """Open the drives, in order of time; only the file lists and the time stamps are read."""
    drives = drives_of(path.absolute())
    with_camera = {drive: any((drive.parent / name).exists() for name in RAW_CALIB)
                   for drive in drives}
    frames, timed = frames_of(drives, need_stamps=with_camera)  # a drive of KITTI has both
    if not frames:
        raise InputError(f"{path} has no KITTI scans: expected DATE/DRIVE_sync/{DATA}/*.bin")
    labels = {drive: truth_by_number(drive / TRACKLETS, read_tracklets) for drive in drives}
    calibrations = {drive: functools.cache(partial(read_raw_calibration, drive.parent))
                    if with_camera[drive] else nothing for drive in drives}
    frames = [replace(frame, truth=partial(labels[frame.native], frame.index),
                      calibration=calibrations[frame.native],
                      files=(*frame.files, frame.native / TRACKLETS,
                             *(frame.native.parent / name for name in RAW_CALIB)))
              for frame in frames]
    labelled = any((drive / TRACKLETS).exists() for drive in drives)
    return Recording(path, "KITTI raw drives", frames, frozenset(
        [CAMERA] * any(with_camera.values()) + [BOXES] * labelled), timed=timed)


def frames_of(drives: Sequence[Path], need_stamps: dict[Path, bool] | None = None
              ) -> tuple[list[Frame], bool]:
    """Return the frames of drives with scans in DATA, in order of time, without labels and camera;
    native is the folder of the drive. And whether all their times are recorded; otherwise 10 Hz is
    assumed, which is an InputError for a drive that needs its stamps."""
    frames: list[Frame] = []
    timed = True
    files = {drive: scans_of(drive) for drive in drives}
    scale = cloud_scale([file for some in files.values() for file in some])
    for drive, scans in files.items():
        numbers = _numbers(drive, scans)
        stamps = _stamps(drive, numbers, bool(need_stamps and need_stamps[drive]))
        timed = timed and bool(stamps)
        start = frames[-1].stamp_ns + GAP_NS if frames else START_NS
        for i, (file, number) in enumerate(zip(scans, numbers)):
            stamp = stamps[i] if stamps else start + (number - numbers[0]) * PERIOD_NS
            frames.append(Frame(
                f"{drive.name}/{file.stem}", stamp, partial(load_scan, file, stamp, scale),
                sequence=drive.name, index=number, points=file,
                image=drive / f"image_02/data/{file.stem}.png", files=(file,), native=drive,
                intensity_max=scale))
    return sorted(frames, key=lambda frame: frame.stamp_ns), timed


def scans_of(drive: Path) -> list[Path]:
    """List the scans of a drive in order of their names; of a name with several suffixes one."""
    files = {file.stem: file for suffix in SUFFIXES for file in (drive / DATA).glob("*")
             if file.suffix.lower() == suffix and is_cloud(file)}
    return [file for _, file in sorted(files.items())]


def load_scan(file: Path, stamp_ns: int, scale: Callable[[], float]) -> LidarFrame:
    """Read the usable points of a scan; scale() is the intensity of a full reflection."""
    if file.suffix.lower() == ".bin":
        return load_velodyne(file, stamp_ns, scale)
    return load_points(file, stamp_ns, LIDAR_FRAME, scale=scale)


def _numbers(drive: Path, files: Sequence[Path]) -> list[int]:
    """The number of each scan: its name, or by the lines "NUMBER NAME" of frame_list.txt."""
    path = drive / FRAME_LIST
    if not path.exists():
        return [number_of(file) for file in files]
    numbers = read_frame_list(path)
    if unknown := [file.name for file in files if file.stem not in numbers]:
        raise InputError(f"{path} does not name {unknown[0]}; export the drive again")
    return [numbers[file.stem] for file in files]


def read_frame_list(path: Path) -> dict[str, int]:
    """Return the numbers of the scans by their names without folder and suffix, from the lines
    "NUMBER NAME" of a file. InputError for another line."""
    rows = [line.split(maxsplit=1) for line in read_text(path, what="the list").splitlines()
            if line.strip() and not line.startswith("#")]
    try:
        return {Path(name.strip()).name: int(number) for number, name in rows}
    except ValueError as error:
        raise InputError(f"{path} has a line that is not NUMBER NAME ({error}); export the drive "
                         "again") from None


def _stamps(drive: Path, numbers: Sequence[int], required: bool) -> list[int]:
    """Nanoseconds of the scans with these numbers, from timestamps.txt of a drive; empty without
    this file, which is an InputError where it is required.

    Lines are "2011-09-26 13:02:25.594360375", read as UTC. Scan i has line i, which is blank where
    a scan is missing, or without blank lines the i-th scan has the i-th line.
    """
    path = drive / "velodyne_points/timestamps.txt"
    if not (required or path.exists()):
        return []
    lines = [line.strip() for line in read_text(path, what="the time stamps").splitlines()]
    timed = [line for line in lines if line]
    if all(0 <= number < len(lines) and lines[number] for number in numbers):
        timed = [lines[number] for number in numbers]
    elif len(timed) != len(numbers):
        missing = next(n for n in numbers if not (0 <= n < len(lines) and lines[n]))
        raise InputError(f"{path} has {len(lines)} lines, and none for scan {missing}; download "
                         "the drive again")
    try:
        return [_nanoseconds(line) for line in timed]
    except ValueError as error:
        raise InputError(f"cannot read the time stamps {path}: {error}") from None


def _nanoseconds(line: str) -> int:
    seconds, _, fraction = line.partition(".")
    when = datetime.strptime(seconds, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
    return int(when.timestamp()) * 10**9 + int(f"{fraction:0<9}"[:9])
