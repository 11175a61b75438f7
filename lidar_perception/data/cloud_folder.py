"""Folders of .pcd, .ply, .npy or .bin files, as written by drivers and labelling tools."""

from __future__ import annotations

import re
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from lidar_perception.data.cloud_files import is_cloud, load_points, make_cloud_scale_reader, to_message
from lidar_perception.data.frame import Frame, Recording
from lidar_perception.data.kitti.folder import PERIOD_NS, START_NS

UNIT_NS_BY_DIGITS = {10: 10**9, 13: 10**6, 16: 10**3, 19: 1}  # number of digits of a Unix time -> its unit in ns
NANOSECOND_DIGITS = 9


def list_cloud_files(path: Path) -> list[Path]:
    """Return the point cloud file at a path, or all point cloud files in a folder.

    They are sorted by the times or numbers in their names (2 before 10).
    """
    files = [file for file in ([path] if path.is_file() else path.glob("*")) if is_cloud(file)]
    if stamps := _parse_stamps(files):
        return [file for _, file in sorted(zip(stamps, files))]
    return sorted(
        files, key=lambda file: [(int(part or -1), text) for text, part in re.findall(r"(\D*)(\d*)", file.name)]
    )


def can_open(path: Path) -> bool:
    """Return True for a point cloud file, or a folder with such files."""
    return bool(list_cloud_files(path))


def open_layout(path: Path, *, points: str = "", scans: bool = True) -> Recording:
    """Open the clouds as one drive without labels.

    Stamps are the Unix times in the file names (in seconds, such as 1700000000.1, or in ms, us or
    ns). If a file name has no time, a rate of 10 Hz is assumed.
    """
    files = list_cloud_files(path)
    names = [file.stem for file in files]
    if len(set(names)) < len(names):
        names = [file.name for file in files]
    times = parse_times(files)
    stamps = times or [START_NS + i * PERIOD_NS for i in range(len(files))]
    suffixes = " and ".join(sorted({file.suffix.lower() for file in files}))
    scale = make_cloud_scale_reader(files)
    return Recording(
        path,
        f"{suffixes} clouds, {'times' if times else 'no times'} in file names",
        [
            Frame(
                name,
                stamp,
                partial(load_points, file, stamp, scale=scale),
                index=i,
                points=file,
                native=partial(to_message, file, stamp),
                intensity_max=scale,
            )
            for i, (name, stamp, file) in enumerate(zip(names, stamps, files))
        ],
        has_sensor_height=False,
        has_times=bool(times),
    )


def parse_times(files: list[Path]) -> list[int]:
    """Return the timestamps in the file names, in ns; [] unless every name has one and they ascend."""
    stamps = _parse_stamps(files)
    return stamps if all(a < b for a, b in pairwise(stamps)) else []


def _parse_stamps(files: list[Path]) -> list[int]:
    """Return the timestamps in the file names, in ns; [] unless every name has one."""
    parts = [part for file in files if (part := _split_name(file)) is not None]
    if len(parts) < len(files):
        return []
    fractions = [fraction for _, fraction in parts]
    as_decimals = [seconds_ns + int(f"{fraction:0<9}"[:9]) for seconds_ns, fraction in parts]
    # Until perception_pcl 2.6.2, pointcloud_to_pcd wrote SECONDS.NANOSECONDS without leading zeros:
    # https://github.com/ros-perception/perception_pcl/pull/481
    short_fractions = [f for f in fractions if len(f) < NANOSECOND_DIGITS]
    if (
        not short_fractions
        or len(short_fractions) == len(fractions)
        or any((f.startswith("0") and f != "0") or len(f) > NANOSECOND_DIGITS for f in fractions)
    ):
        return as_decimals
    as_nanoseconds = [seconds_ns + int(fraction or 0) for seconds_ns, fraction in parts]
    spreads = [np.ptp(np.diff(sorted(stamps))) for stamps in (as_decimals, as_nanoseconds)]
    if any(f.endswith("0") for f in short_fractions) or spreads[1] < spreads[0]:
        return as_nanoseconds
    return as_decimals


def _split_name(file: Path) -> tuple[int, str] | None:
    """Return the integer part of the timestamp in a file name, in ns, and its fractional digits.

    Returns None if the name is not a timestamp. The names of frames in KITTI's raw drives also have
    ten digits, but start with 0.
    """
    seconds, _, fraction = file.name.removesuffix(file.suffix).partition(".")
    if (
        not seconds.isdecimal()
        or seconds[0] == "0"
        or len(seconds) not in UNIT_NS_BY_DIGITS
        or (fraction and (len(seconds) != 10 or not fraction.isdecimal()))
    ):
        return None
    return int(seconds) * UNIT_NS_BY_DIGITS[len(seconds)], fraction
