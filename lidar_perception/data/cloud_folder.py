"""Folders of .pcd, .ply, .npy or .bin files, as drivers and labelling tools write them."""

from __future__ import annotations

import re
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from lidar_perception.data.cloud_files import cloud_scale, is_cloud, load_points, to_message
from lidar_perception.data.frame import Frame, Recording
from lidar_perception.data.kitti.folder import PERIOD_NS, START_NS

UNITS = {10: 10**9, 13: 10**6, 16: 10**3, 19: 1}  # digits of a Unix time of today: ns of its unit
NANOSECOND_DIGITS = 9


def cloud_files(path: Path) -> list[Path]:
    """List the file at a path, or those in the folder, in order of the times that their names give,
    else of the numbers in their names (2 before 10); empty where there is no cloud."""
    files = [file for file in ([path] if path.is_file() else path.glob("*")) if is_cloud(file)]
    if stamps := _stamps(files):
        return [file for _, file in sorted(zip(stamps, files))]
    return sorted(files, key=lambda file: [
        (int(part or -1), text) for text, part in re.findall(r"(\D*)(\d*)", file.name)])


def recognises(path: Path) -> bool:
    """Return True for such a file, or a folder with some."""
    return bool(cloud_files(path))


def open_recording(path: Path, *, points: str = "", scans: bool = True) -> Recording:
    """Open the clouds as one drive without labels. Times are those that all names say (Unix times
    in seconds, as 1700000000.1, or in ms, us or ns), else 10 Hz."""
    files = cloud_files(path)
    names = [file.stem for file in files]
    if len(set(names)) < len(names):
        names = [file.name for file in files]
    times = named_times(files)
    stamps = times or [START_NS + i * PERIOD_NS for i in range(len(files))]
    kinds = " and ".join(sorted({file.suffix.lower() for file in files}))
    scale = cloud_scale(files)
    return Recording(path, f"{kinds} clouds, {'times' if times else 'no times'} in their names",
                     [Frame(name, stamp, partial(load_points, file, stamp, scale=scale), index=i,
                            points=file, native=partial(to_message, file, stamp),
                            intensity_max=scale)
                      for i, (name, stamp, file) in enumerate(zip(names, stamps, files))],
                     mounted=False, timed=bool(times))


def named_times(files: list[Path]) -> list[int]:
    """Return the nanoseconds that the names of the files give, ascending; empty where one gives
    none."""
    stamps = _stamps(files)
    return stamps if all(a < b for a, b in pairwise(stamps)) else []


def _stamps(files: list[Path]) -> list[int]:
    """Nanoseconds in the names of the files, one for each; empty where one has none."""
    parts = [part for file in files if (part := _parts(file)) is not None]
    if len(parts) < len(files):
        return []
    fractions = [fraction for _, fraction in parts]
    decimal = [whole + int(f"{fraction:0<9}"[:9]) for whole, fraction in parts]
    # Up to perception_pcl 2.6.2, pointcloud_to_pcd wrote SECONDS.NANOSECONDS without leading zeros:
    # https://github.com/ros-perception/perception_pcl/pull/481
    shorter = [f for f in fractions if len(f) < NANOSECOND_DIGITS]
    if not shorter or len(shorter) == len(fractions) or any(
            (f.startswith("0") and f != "0") or len(f) > NANOSECOND_DIGITS for f in fractions):
        return decimal
    counted = [whole + int(fraction or 0) for whole, fraction in parts]
    uneven = [np.ptp(np.diff(sorted(stamps))) for stamps in (decimal, counted)]
    return counted if any(f.endswith("0") for f in shorter) or uneven[1] < uneven[0] else decimal


def _parts(file: Path) -> tuple[int, str] | None:
    """Nanoseconds before the point in the name of a file, and the digits behind it; None where it
    is no time: a frame of KITTI's raw data has ten digits, too, the first of them 0."""
    whole, _, fraction = file.name.removesuffix(file.suffix).partition(".")
    if not whole.isdecimal() or whole[0] == "0" or len(whole) not in UNITS or (
            fraction and (len(whole) != 10 or not fraction.isdecimal())):
        return None
    return int(whole) * UNITS[len(whole)], fraction
