"""KITTI folders: the 3D-object, tracking and raw layouts, frame by frame."""

from __future__ import annotations

import functools
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.frame import BOXES, CAMERA, Frame, Recording
from lidar_perception.data.kitti.calibration import (
    RAW_CALIB,
    read_calibration,
    read_raw_calibration,
)
from lidar_perception.data.kitti.labels import (
    read_object_labels,
    read_tracking_labels,
    read_tracklets,
)
from lidar_perception.data.records import read_records
from lidar_perception.runs.files import regular
from lidar_perception.types import GroundTruth, InputError, LidarFrame
from lidar_perception.wire.topics import LIDAR_FRAME

START_NS = 1_316_995_200 * 10**9  # 26 September 2011, the first day of KITTI's recordings
PERIOD_NS = 10**8                 # the sensor turns at 10 Hz
GAP_NS = 10 * 10**9               # between recordings that share a bag
OBJECT = "object data"            # the layout whose frames are from anywhere
SCANS = ("velodyne_reduced", "velodyne")  # of one name, the full scan wins


def read_velodyne(path: Path) -> np.ndarray:
    """(N, 4) float32 [x y z reflectance] of a .bin file."""
    return read_records(path, "x y z reflectance")


def load_velodyne(path: Path, stamp_ns: int) -> LidarFrame:
    """The usable points of a .bin file."""
    cloud = read_velodyne(path)
    return LidarFrame.of(cloud[:, :3], cloud[:, 3].copy(), stamp_ns, LIDAR_FRAME)


def recognises(path: Path) -> bool:
    """Whether a KITTI folder lies there, of any layout, or labels that wait for one."""
    return (any((folder / name).is_dir() for folder in (path / "training", path)
                for name in (*SCANS, "label_2"))
            or any(next(path.glob(f"{days}velodyne_points/data"), None)
                   for days in ("", "*/", "*/*/")))


def open_recording(path: Path, *, points: str = "", scans: bool = True) -> Recording:
    """The frames of a KITTI folder, in order of time; nothing is read but the file lists.

    path is a 3D-object or tracking folder (with velodyne/, or its parent with training/), or a
    raw drive, day or folder of days. Without scans, labels are enough to make a frame in the
    object layout: its points may not exist. InputError says what is missing.
    """
    for folder in (path / "training", path):
        known = SCANS if scans else (*SCANS, "label_2")
        if any((folder / name).is_dir() for name in known):
            if (folder / "label_02").is_dir() or any(
                    any(folder.glob(f"{name}/*/")) for name in SCANS):
                frames, layout = _tracking(folder), "tracking data"
            else:
                frames, layout = _object(folder, scans), OBJECT
            labelled = (folder / "label_02").is_dir() or (folder / "label_2").is_dir()
            break
    else:
        frames, layout = _raw(path.absolute()), "raw drives"
        labelled = any((frame.native / "tracklet_labels.xml").exists() for frame in frames)
    if not frames:
        raise InputError(f"{path} has no KITTI scans: expected training/velodyne/*.bin (object), "
                         "training/velodyne/0000/*.bin (tracking) or "
                         "DATE/DRIVE_sync/velodyne_points/data/*.bin (raw)")
    lost = sorted(label for folder in (path / "training", path)
                  for label in folder.glob("label_2/*.txt")
                  if not any((folder / name / f"{label.stem}.bin").exists() for name in SCANS))
    return Recording(path, f"KITTI {layout}", frames,
                     frozenset({CAMERA} | ({BOXES} if labelled else set())),
                     tuple((label.stem, f"{label} has no scan; download it again")
                           for label in lost) if scans else (), drives=layout != OBJECT,
                     timed=layout == "raw drives")


def _object(folder: Path, scans: bool) -> list[Frame]:
    files = {} if scans else {p.stem: folder / f"velodyne/{p.stem}.bin"
                              for p in folder.glob("label_2/*.txt")}
    files |= {p.stem: p for name in SCANS for p in folder.glob(f"{name}/*.bin")}
    frames = []
    for i, (name, points) in enumerate(sorted(files.items())):
        image, label = folder / f"image_2/{name}.png", folder / f"label_2/{name}.txt"
        calib = folder / f"calib/{name}.txt"
        calibration = functools.cache(partial(read_calibration, calib, image))
        stamp = START_NS + i * PERIOD_NS
        frames.append(Frame(name, stamp, partial(load_velodyne, points, stamp),
                            partial(_object_truth, label, calibration), calibration=calibration,
                            index=i, points=points, image=image,
                            files=(points, label, calib)))
    return frames


def _object_truth(label: Path, calibration: Callable[[], Calibration]) -> GroundTruth | None:
    return read_object_labels(label, calibration().lidar_to_camera) if label.exists() else None


def _tracking(folder: Path) -> list[Frame]:
    frames, start = [], START_NS
    drives = {drive.name: drive for name in SCANS for drive in sorted(folder.glob(f"{name}/*/"))}
    for name, drive in sorted(drives.items()):
        scans = sorted(drive.glob("*.bin"))
        images = folder / "image_02" / name
        calib, label = folder / f"calib/{name}.txt", folder / f"label_02/{name}.txt"
        calibration = functools.cache(partial(
            read_calibration, calib, images / f"{scans[0].stem}.png" if scans else None))
        truth = _truth_by_number(label, partial(_tracking_truth, calibration))
        for points in scans:
            number = number_of(points)
            stamp = start + (number - number_of(scans[0])) * PERIOD_NS
            frames.append(Frame(f"{name}/{points.stem}", stamp,
                                partial(load_velodyne, points, stamp), partial(truth, number),
                                calibration=calibration, sequence=name, index=number,
                                points=points, image=images / f"{points.stem}.png",
                                files=(points, label, calib)))
        start = frames[-1].stamp_ns + GAP_NS if frames else start
    return frames


def _tracking_truth(calibration: Callable[[], Calibration], label: Path
                    ) -> dict[int, GroundTruth]:
    return read_tracking_labels(label, calibration().lidar_to_camera)


def _raw(root: Path) -> list[Frame]:
    drives = {p.parent.parent for pattern in
              ("velodyne_points/data", "*/velodyne_points/data", "*/*/velodyne_points/data")
              for p in root.glob(pattern + "/*.bin")}
    frames = []
    for drive in sorted(d.parent for d in drives):
        calibration = functools.cache(partial(read_raw_calibration, drive.parent))
        label = drive / "tracklet_labels.xml"
        truth = _truth_by_number(label, read_tracklets)
        stamps = _raw_stamps(drive / "velodyne_points" / "timestamps.txt")
        for points in sorted((drive / "velodyne_points/data").glob("*.bin")):
            number = number_of(points)
            if number >= len(stamps):
                raise InputError(f"{drive}/velodyne_points/timestamps.txt has {len(stamps)} lines "
                                 f"but there is a scan {points.name}; download the drive again")
            stamp = stamps[number]
            frames.append(Frame(f"{drive.name}/{points.stem}", stamp,
                                partial(load_velodyne, points, stamp), partial(truth, number),
                                calibration=calibration, sequence=drive.name, index=number,
                                points=points, image=drive / f"image_02/data/{points.stem}.png",
                                files=(points, label, *(drive.parent / name for name in RAW_CALIB)),
                                native=drive))
    return sorted(frames, key=lambda f: f.stamp_ns)


def _truth_by_number(path: Path, read: Callable[[Path], dict[int, GroundTruth]]
                     ) -> Callable[[int], GroundTruth | None]:
    """The labels of a frame by its number, from the file of its drive, read once."""
    labels = functools.cache(partial(read, path))

    def truth(number: int) -> GroundTruth | None:
        return labels().get(number, _NO_OBJECTS) if path.exists() else None
    return truth


def number_of(scan: Path) -> int:
    """The number of a scan in its drive, which is its file's name. InputError where it is none."""
    try:
        return int(scan.stem)
    except ValueError:
        raise InputError(f"{scan} is no KITTI scan: its name is no number; move it away") from None


def _raw_stamps(path: Path) -> list[int]:
    """Nanoseconds of the lines '2011-09-26 13:02:25.594360375', read as UTC."""
    try:
        stamps = []
        for line in regular(path).read_text().split("\n"):
            if line.strip():
                seconds, _, fraction = line.strip().partition(".")
                when = datetime.strptime(seconds, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
                stamps.append(int(when.timestamp()) * 10**9 + int(f"{fraction:0<9}"[:9]))
        return stamps
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read the time stamps {path}: {error}") from None


_NO_OBJECTS = GroundTruth.of([], [])
