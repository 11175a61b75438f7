"""Clouds in files of their own, .pcd or .bin, as drivers and labelling tools write them."""

from __future__ import annotations

import re
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.data.frame import Frame, Recording
from lidar_perception.data.kitti.folder import PERIOD_NS, START_NS
from lidar_perception.data.nuscenes.folder import SWEEP
from lidar_perception.data.pcd import read_pcd
from lidar_perception.data.records import read_records
from lidar_perception.types import InputError, LidarFrame
from lidar_perception.wire.codec import bag_message
from lidar_perception.wire.messages import to_frame
from msg_utils.point_cloud2 import from_array
from msg_utils.stamps import header_message

SUFFIXES = (".pcd", ".bin")
KITTI = "x y z intensity"
MAX_RING = 256
SAMPLE = 2000  # points on which the columns of a .bin file are told
NEGATIVE = 0.1  # of them; where more have a negative intensity the columns are others
UNITS = {10: 10**9, 13: 10**6, 16: 10**3, 19: 1}  # digits of a Unix time of today: ns of its unit


def cloud_files(path: Path) -> list[Path]:
    """The file at path, or those in the folder in order: of the times that their names are, else
    of the numbers in them (2 before 10); none where there is no cloud."""
    files = [path] if path.is_file() else [
        file for file in path.glob("*") if file.suffix in SUFFIXES and file.is_file()]
    times = {file: _named_time(file) for file in files if file.suffix in SUFFIXES}
    if None not in times.values():
        return sorted(times, key=lambda file: (times[file], file.name))
    return sorted(times, key=lambda file: [
        (int(part or -1), text) for text, part in re.findall(r"(\D*)(\d*)", file.name)])


def recognises(path: Path) -> bool:
    """Whether such a file lies there, or a folder with some."""
    return bool(cloud_files(path))


def open_recording(path: Path, *, points: str = "", scans: bool = True) -> Recording:
    """The clouds as one drive without labels. Times are those that all names say (Unix times in
    seconds, as 1700000000.1, or in ms, us or ns), else 10 Hz."""
    files = cloud_files(path)
    names = [file.stem for file in files]
    if len(set(names)) < len(names):
        names = [file.name for file in files]
    said = named_times(files)
    stamps = said or [START_NS + i * PERIOD_NS for i in range(len(files))]
    kinds = " and ".join(sorted({file.suffix for file in files}))
    return Recording(path, f"{kinds} clouds, {'times' if said else 'no times'} in their names",
                     [Frame(name, stamp, partial(_load, file, stamp), index=i, points=file,
                            native=partial(to_message, file, stamp))
                      for i, (name, stamp, file) in enumerate(zip(names, stamps, files))],
                     mounted=False)


def named_times(files: list[Path]) -> list[int]:
    """Nanoseconds that the names of the files are, in ascending order; none where one is not."""
    stamps = [stamp for file in files if (stamp := _named_time(file)) is not None]
    return stamps if len(stamps) == len(files) and all(
        a < b for a, b in pairwise(stamps)) else []


def _named_time(file: Path) -> int | None:
    """Nanoseconds that the name of a file is; None where it is none: a frame of KITTI's raw data
    has ten digits, too, the first of them 0."""
    whole, _, fraction = file.name.removesuffix(file.suffix).partition(".")
    if not whole.isdecimal() or whole[0] == "0" or len(whole) not in UNITS or (
            fraction and (len(whole) != 10 or not fraction.isdecimal())):
        return None
    return int(whole) * UNITS[len(whole)] + int(f"{fraction:0<9}"[:9] or 0)


def read_points(file: Path) -> np.ndarray:
    """(N,) structured array with the columns of the file. InputError where it is no cloud."""
    points = read_pcd(file) if file.suffix == ".pcd" else _of_records(file)
    if missing := {"x", "y", "z"} - set(points.dtype.names or ()):
        raise InputError(f"{file} has no field {min(missing)}; it is no cloud of points")
    return points


def to_message(file: Path, stamp_ns: int = 0) -> Any:
    """A file as a PointCloud2 of rosbags' class."""
    points = read_points(file)
    # A PointCloud2 has no whole numbers of 64 bits: times as float64 keep their microseconds.
    kinds = [(name, points.dtype[name].base.str.replace("i8", "f8").replace("u8", "f8"),
              points.dtype[name].shape) for name in points.dtype.names or ()]
    try:
        return from_array(points.astype(kinds), header_message(stamp_ns, "", bag_message),
                          bag_message)
    except ValueError as error:
        raise InputError(f"{file}: {error}") from None


def _load(file: Path, stamp_ns: int) -> LidarFrame:
    try:
        return to_frame(to_message(file, stamp_ns), 0.0)[0]
    except InputError as error:
        raise InputError(str(error) if str(file) in str(error) else f"{file}: {error}") from None


def _of_records(file: Path) -> np.ndarray:
    """A .bin file of float32: KITTI's four columns, or nuScenes' five, whose last is the ring.
    InputError where it has others: nothing in it says how many."""
    if file.stat().st_size % 20 == 0:
        cloud = read_records(file, SWEEP)
        ring = cloud[:SAMPLE, 4]
        with np.errstate(invalid="ignore"):
            if ((ring >= 0) & (ring < MAX_RING) & (ring == np.floor(ring))).all():
                return _structured(cloud, SWEEP)
    cloud = read_records(file, KITTI)
    intensity = cloud[:SAMPLE, 3]
    if np.count_nonzero(intensity < 0) > NEGATIVE * len(intensity):
        raise InputError(f"{file} is not of the columns {KITTI}, nor {SWEEP}, as float32: much of "
                         "the intensity would be negative; save it as .pcd, which names columns")
    return _structured(cloud, KITTI)


def _structured(cloud: np.ndarray, columns: str) -> np.ndarray:
    names = columns.split()
    return np.ascontiguousarray(cloud).view([(name, np.float32) for name in names]).reshape(-1)
