"""KITTI's raw drives, and drives exported in this layout by CVAT, Datumaro and Supervisely.

Exported drives have .pcd files and neither time stamps nor calibration.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from lidar_perception.data.cloud_files import SUFFIXES, is_cloud, load_points, make_cloud_scale_reader
from lidar_perception.data.frame import BOXES, CAMERA, Frame, Recording, return_none
from lidar_perception.data.kitti.calibration import RAW_CALIB, read_raw_calibration
from lidar_perception.data.kitti.folder import (
    GAP_NS,
    PERIOD_NS,
    START_NS,
    load_velodyne,
    make_truth_reader,
    parse_scan_number,
)
from lidar_perception.data.kitti.labels import read_tracklets
from lidar_perception.runs.files import read_text
from lidar_perception.types import InputError, PointCloud
from lidar_perception.wire.topics import LIDAR_FRAME

SCAN_FOLDER = "velodyne_points/data"
TRACKLETS, FRAME_LIST = "tracklet_labels.xml", "frame_list.txt"


def can_open(path: Path) -> bool:
    """Return True for a drive, a day with drives, or a folder of days."""
    return bool(list_drives(path))


def list_drives(path: Path) -> list[Path]:
    """Return the drives at a path, sorted."""
    return sorted(data.parents[1] for days in ("", "*/", "*/*/") for data in path.glob(days + SCAN_FOLDER))


def open_layout(path: Path, *, points: str = "", scans: bool = True) -> Recording:
    """Open the drives in order of time; only file lists and time stamps are read."""
    drives = list_drives(path.absolute())
    has_camera = {drive: any((drive.parent / name).exists() for name in RAW_CALIB) for drive in drives}
    # A drive with a calibration comes from KITTI and has time stamps.
    frames, has_times = make_frames(drives, need_stamps=has_camera)
    if not frames:
        raise InputError(f"{path} has no KITTI scans: expected DATE/DRIVE_sync/{SCAN_FOLDER}/*.bin")
    labels = {drive: make_truth_reader(drive / TRACKLETS, read_tracklets) for drive in drives}
    calibrations = {
        drive: functools.cache(partial(read_raw_calibration, drive.parent)) if has_camera[drive] else return_none
        for drive in drives
    }
    frames = [
        replace(
            frame,
            truth=partial(labels[frame.native], frame.index),
            calibration=calibrations[frame.native],
            files=(*frame.files, frame.native / TRACKLETS, *(frame.native.parent / name for name in RAW_CALIB)),
        )
        for frame in frames
    ]
    has_labels = any((drive / TRACKLETS).exists() for drive in drives)
    return Recording(
        path,
        "KITTI raw drives",
        frames,
        frozenset([CAMERA] * any(has_camera.values()) + [BOXES] * has_labels),
        has_times=has_times,
    )


def make_frames(drives: Sequence[Path], need_stamps: dict[Path, bool] | None = None) -> tuple[list[Frame], bool]:
    """Make the frames of drives in order of time, without labels and camera.

    Args:
        drives: folders with scans in SCAN_FOLDER.
        need_stamps: True for each drive that must have time stamps.

    Returns:
        The frames, with the folder of the drive as `native`, and False if a drive has no time
        stamps and 10 Hz is assumed.

    Raises:
        InputError: required time stamps are missing.
    """
    frames: list[Frame] = []
    has_times = True
    files = {drive: list_scans(drive) for drive in drives}
    scale = make_cloud_scale_reader([scan for scans in files.values() for scan in scans])
    for drive, scans in files.items():
        numbers = _read_numbers(drive, scans)
        stamps = _read_stamps(drive, numbers, bool(need_stamps and need_stamps[drive]))
        has_times = has_times and bool(stamps)
        start = frames[-1].stamp_ns + GAP_NS if frames else START_NS
        for i, (file, number) in enumerate(zip(scans, numbers)):
            stamp = stamps[i] if stamps else start + (number - numbers[0]) * PERIOD_NS
            frames.append(
                Frame(
                    f"{drive.name}/{file.stem}",
                    stamp,
                    partial(load_scan, file, stamp, scale),
                    sequence=drive.name,
                    index=number,
                    points=file,
                    image=drive / f"image_02/data/{file.stem}.png",
                    files=(file,),
                    native=drive,
                    intensity_max=scale,
                )
            )
    return sorted(frames, key=lambda frame: frame.stamp_ns), has_times


def list_scans(drive: Path) -> list[Path]:
    """Return the scans of a drive, sorted by name, and only one of scans that differ in the suffix."""
    files = {
        file.stem: file
        for suffix in SUFFIXES
        for file in (drive / SCAN_FOLDER).glob("*")
        if file.suffix.lower() == suffix and is_cloud(file)
    }
    return [file for _, file in sorted(files.items())]


def load_scan(file: Path, stamp_ns: int, scale: Callable[[], float]) -> PointCloud:
    """Load the usable points of a scan; scale() returns the intensity of a full reflection."""
    if file.suffix.lower() == ".bin":
        return load_velodyne(file, stamp_ns, scale)
    return load_points(file, stamp_ns, LIDAR_FRAME, scale=scale)


def _read_numbers(drive: Path, files: Sequence[Path]) -> list[int]:
    path = drive / FRAME_LIST
    if not path.exists():
        return [parse_scan_number(file) for file in files]
    numbers = read_frame_list(path)
    if unknown_names := [file.name for file in files if file.stem not in numbers]:
        raise InputError(f"{path} does not list {unknown_names[0]}; export the drive again")
    return [numbers[file.stem] for file in files]


def read_frame_list(path: Path) -> dict[str, int]:
    """Read a file with lines "NUMBER NAME" and return the number of each scan.

    Scans are identified by their name without folder and suffix. Raises InputError if a line has
    another format.
    """
    rows = [
        line.split(maxsplit=1)
        for line in read_text(path, noun="the list").splitlines()
        if line.strip() and not line.startswith("#")
    ]
    try:
        return {Path(name.strip()).name: int(number) for number, name in rows}
    except ValueError as error:
        raise InputError(f"{path} has a line that is not NUMBER NAME ({error}); export the drive again") from None


def _read_stamps(drive: Path, numbers: Sequence[int], required: bool) -> list[int]:
    """Return the stamps, in ns, of the scans with these numbers from timestamps.txt.

    A line is a UTC time such as 2011-09-26 13:02:25.594360375. Line i belongs to scan number i, and
    is blank if the scan is missing. In files without blank lines, the i-th line belongs to the i-th
    scan. The result is [] if the file does not exist and is not required.
    """
    path = drive / "velodyne_points/timestamps.txt"
    if not (required or path.exists()):
        return []
    lines = [line.strip() for line in read_text(path, noun="the time stamps").splitlines()]
    stamp_lines = [line for line in lines if line]
    if all(0 <= number < len(lines) and lines[number] for number in numbers):
        stamp_lines = [lines[number] for number in numbers]
    elif len(stamp_lines) != len(numbers):
        missing_number = next(n for n in numbers if not (0 <= n < len(lines) and lines[n]))
        raise InputError(f"{path} has no line for scan {missing_number} ({len(lines)} lines); download the drive again")
    try:
        return [_parse_stamp(line) for line in stamp_lines]
    except ValueError as error:
        raise InputError(f"cannot read the time stamps {path}: {error}") from None


def _parse_stamp(line: str) -> int:
    seconds, _, fraction = line.partition(".")
    time = datetime.strptime(seconds, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
    return int(time.timestamp()) * 10**9 + int(f"{fraction:0<9}"[:9])
