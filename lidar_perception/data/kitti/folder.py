"""KITTI folders: the 3D-object, tracking and raw layouts, frame by frame."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.kitti.calibration import read_calibration, read_raw_calibration
from lidar_perception.data.kitti.labels import (
    read_object_labels,
    read_tracking_labels,
    read_tracklets,
)
from lidar_perception.types import GroundTruth, InputError, LidarFrame, usable_returns
from lidar_perception.wire.topics import LIDAR_FRAME

START_NS = 1_316_995_200 * 10**9  # 26 September 2011, the first day of KITTI's recordings
PERIOD_NS = 10**8                 # the sensor turns at 10 Hz
GAP_NS = 10 * 10**9               # between recordings that share a bag
SCANS = ("velodyne_reduced", "velodyne")  # of one name, the full scan wins


@dataclass(frozen=True)
class KittiFrame:
    """One scan. truth() is None where the folder has no labels; image may not exist."""

    name: str
    points: Path
    stamp_ns: int
    calibration: Callable[[], Calibration]
    truth: Callable[[], GroundTruth | None]
    image: Path | None = None

    def cloud(self) -> np.ndarray:
        """(N, 4) float32 [x y z reflectance], as in the file."""
        return read_velodyne(self.points)

    def load(self) -> LidarFrame:
        cloud = self.cloud()
        cloud = cloud.compress(usable_returns(cloud[:, :3]), axis=0)
        return LidarFrame(np.ascontiguousarray(cloud[:, :3]), cloud[:, 3].copy(), self.stamp_ns,
                          LIDAR_FRAME)


def read_velodyne(path: Path) -> np.ndarray:
    """(N, 4) float32 [x y z reflectance] of a .bin file."""
    try:
        raw = np.fromfile(path, np.float32)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error}") from None
    if path.stat().st_size % 16:
        raise InputError(f"{path} has {path.stat().st_size} bytes, not a multiple of 16 (x y z "
                         "reflectance as float32); it was cut, download it again")
    return raw.reshape(-1, 4)


def open_kitti(root: str | Path, scans: bool = True) -> list[KittiFrame]:
    """The frames of a KITTI folder, in order of time; nothing is read but the file lists.

    root is a 3D-object or tracking folder (with velodyne/, or its parent with training/), or a
    raw drive, day or folder of days. Without scans, labels are enough to make a frame in the
    object layout: its points may not exist. InputError says what is missing.
    """
    root = Path(root)
    if not root.is_dir():
        raise InputError(f"{root} is not a folder; give the folder of a KITTI download")
    for folder in (root / "training", root):
        known = SCANS if scans else (*SCANS, "label_2")
        if any((folder / name).is_dir() for name in known):
            tracking = (folder / "label_02").is_dir() or any(folder.glob("velodyne/*/"))
            frames = _tracking(folder) if tracking else _object(folder, scans)
            break
    else:
        frames = _raw(root)
    if not frames:
        raise InputError(f"{root} has no KITTI scans: expected training/velodyne/*.bin (object), "
                         "training/velodyne/0000/*.bin (tracking) or "
                         "DATE/DRIVE_sync/velodyne_points/data/*.bin (raw)")
    return frames


def labels_without_scan(root: str | Path) -> list[Path]:
    """Label files of a 3D-object folder whose scans are not there."""
    return sorted(label for folder in (Path(root) / "training", Path(root))
                  for label in folder.glob("label_2/*.txt")
                  if not any((folder / name / f"{label.stem}.bin").exists() for name in SCANS))


def _object(folder: Path, scans: bool) -> list[KittiFrame]:
    files = {} if scans else {p.stem: folder / f"velodyne/{p.stem}.bin"
                              for p in folder.glob("label_2/*.txt")}
    files |= {p.stem: p for name in SCANS for p in folder.glob(f"{name}/*.bin")}
    frames = []
    for i, (name, points) in enumerate(sorted(files.items())):
        image, label = folder / f"image_2/{name}.png", folder / f"label_2/{name}.txt"
        calibration = functools.cache(
            functools.partial(read_calibration, folder / f"calib/{name}.txt", image))

        def truth(label=label, calibration=calibration):
            return (read_object_labels(label, calibration().lidar_to_camera)
                    if label.exists() else None)

        frames.append(KittiFrame(name, points, START_NS + i * PERIOD_NS, calibration, truth, image))
    return frames


def _tracking(folder: Path) -> list[KittiFrame]:
    frames, start = [], START_NS
    for sequence in sorted(folder.glob("velodyne/*/")):
        scans = sorted(sequence.glob("*.bin"))
        images = folder / "image_02" / sequence.name
        calibration = functools.cache(functools.partial(
            read_calibration, folder / f"calib/{sequence.name}.txt",
            images / f"{scans[0].stem}.png" if scans else None))
        labels = folder / f"label_02/{sequence.name}.txt"

        @functools.cache
        def all_labels(labels=labels, calibration=calibration):
            return read_tracking_labels(labels, calibration().lidar_to_camera)

        def truth(frame, labels=labels, all_labels=all_labels):
            return all_labels().get(frame, _NO_OBJECTS) if labels.exists() else None

        for points in scans:
            frame = _number(points)
            stamp = start + (frame - _number(scans[0])) * PERIOD_NS
            frames.append(KittiFrame(f"{sequence.name}/{points.stem}", points, stamp, calibration,
                                     functools.partial(truth, frame),
                                     images / f"{points.stem}.png"))
        start = frames[-1].stamp_ns + GAP_NS if frames else start
    return frames


def _raw(root: Path) -> list[KittiFrame]:
    drives = {p.parent.parent for pattern in
              ("velodyne_points/data", "*/velodyne_points/data", "*/*/velodyne_points/data")
              for p in root.glob(pattern + "/*.bin")}
    frames = []
    for drive in sorted(d.parent for d in drives):
        calibration = functools.cache(functools.partial(read_raw_calibration, drive.parent))
        tracklets = drive / "tracklet_labels.xml"

        @functools.cache
        def all_labels(tracklets=tracklets):
            return read_tracklets(tracklets)

        def truth(frame, tracklets=tracklets, all_labels=all_labels):
            return all_labels().get(frame, _NO_OBJECTS) if tracklets.exists() else None

        stamps = _raw_stamps(drive / "velodyne_points" / "timestamps.txt")
        for points in sorted((drive / "velodyne_points/data").glob("*.bin")):
            frame = _number(points)
            if frame >= len(stamps):
                raise InputError(f"{drive}/velodyne_points/timestamps.txt has {len(stamps)} lines "
                                 f"but there is a scan {points.name}; download the drive again")
            frames.append(KittiFrame(f"{drive.name}/{points.stem}", points, stamps[frame],
                                     calibration, functools.partial(truth, frame),
                                     drive / f"image_02/data/{points.stem}.png"))
    return sorted(frames, key=lambda f: f.stamp_ns)


def _number(scan: Path) -> int:
    try:
        return int(scan.stem)
    except ValueError:
        raise InputError(f"{scan} is no KITTI scan: its name is no number; move it away") from None


def _raw_stamps(path: Path) -> list[int]:
    """Nanoseconds of the lines '2011-09-26 13:02:25.594360375', read as UTC."""
    try:
        stamps = []
        for line in path.read_text().split("\n"):
            if line.strip():
                seconds, _, fraction = line.strip().partition(".")
                when = datetime.strptime(seconds, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
                stamps.append(int(when.timestamp()) * 10**9 + int(f"{fraction:0<9}"[:9]))
        return stamps
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read the time stamps {path}: {error}") from None


_NO_OBJECTS = GroundTruth.of([], [])
