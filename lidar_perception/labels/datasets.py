"""A recording as the folder of a data set, that other tools and open_layout read: the way back
from a bag.

What a layout has no place for is left out, and said.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data import semantickitti
from lidar_perception.data.frame import Frame
from lidar_perception.data.kitti.folder import GAP_NS, PERIOD_NS
from lidar_perception.data.kitti.write import format_calibration, write_object_text, write_velodyne
from lidar_perception.data.mounting import write_height
from lidar_perception.labels.datasets_nuscenes import NuscenesTables
from lidar_perception.labels.drive_labels import NO_TRACK, DriveLabels, FrameLabels, of_truth
from lidar_perception.labels.formats import kitti_object, kitti_tracking
from lidar_perception.labels.formats.nuscenes import LIKE
from lidar_perception.labels.names import format_name
from lidar_perception.runs.files import write_bytes, write_folder
from lidar_perception.simulation.camera import FORWARD_CAMERA
from lidar_perception.types import SENSOR_HEIGHT, InputError

# For a recording without a camera: its axes, level at the LiDAR, with KITTI's field of view.
NO_CAMERA = replace(FORWARD_CAMERA, lidar_to_camera=np.array(
    [[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]))


@dataclass(frozen=True)
class Placed:
    """A frame and its labels, and where it goes: the number of its drive, of the frame there, and
    of the frame in all."""

    frame: Frame
    labels: FrameLabels
    drive: int
    index: int
    number: int


@dataclass
class Summary:
    """What was written. remarks: what the layout has no place for, or was assumed, with the number
    of frames of which that is so."""

    frames: int = 0
    boxes: int = 0
    drives: int = 0
    remarks: dict[str, int] = field(default_factory=dict)

    def remark(self, what: str) -> None:
        """One frame more."""
        self.remarks[what] = self.remarks.get(what, 0) + 1


def write_dataset(layout: str, frames: Iterable[Frame], out: Path,
                  labels: DriveLabels | None = None, force: bool = False) -> Summary:
    """Write the frames of a recording, in their order, as one of LAYOUTS. labels: of the same
    frames, instead of the recording's own. InputError where something cannot be read or written;
    then `out` is as it was.

    Frames get new numbers from 0, in KITTI's tracking layout by their time at 10 Hz. A drive ends
    where the recording says so, at a gap of 5 s, and where the calibration changes. How high the
    sensor is, if not as KITTI's, is written beside, see data/mounting.py.
    """
    layout = format_name(layout, LAYOUTS)
    summary = Summary()
    with write_folder(out, force) as folder:
        for placed in LAYOUTS[layout](folder, _placed(frames, labels), summary):
            if placed.number == 0 and placed.frame.sensor_height != SENSOR_HEIGHT:
                write_height(folder, placed.frame.sensor_height)
            summary.frames += 1
            summary.boxes += len(placed.labels)
            summary.drives = placed.drive + 1
        if summary.frames == 0:
            raise InputError("there is no frame to write; give a recording with clouds")
    return summary


def _placed(frames: Iterable[Frame], labels: DriveLabels | None) -> Iterator[Placed]:
    drive, index, start, before = -1, 0, 0, None
    for number, frame in enumerate(frames):
        if before is None or not _same_drive(before, frame):
            drive, index, start = drive + 1, -1, frame.stamp_ns
        steps = round((frame.stamp_ns - start) / PERIOD_NS)
        in_time = abs(frame.stamp_ns - start - steps * PERIOD_NS) < PERIOD_NS // 4
        index = steps if in_time and steps > index else index + 1
        own = labels.frames[number] if labels is not None else of_truth(frame)
        before = frame
        yield Placed(frame, own, drive, index, number)


def _same_drive(before: Frame, frame: Frame) -> bool:
    ours, theirs = before.calibration(), frame.calibration()
    same = ours is theirs or (ours is not None and ours.equals(theirs))
    return (before.sequence == frame.sequence and same
            and 0 <= frame.stamp_ns - before.stamp_ns < GAP_NS // 2)


def _with_camera(frame: Frame, summary: Summary) -> tuple[Frame, Calibration]:
    """The frame, with NO_CAMERA if it has none."""
    calibration = frame.calibration()
    if calibration is None:
        summary.remark("assumed: a camera at the LiDAR, looking ahead, as KITTI's labels need one")
        calibration = NO_CAMERA
    return replace(frame, calibration=lambda: calibration), calibration


def _cloud(frame: Frame, summary: Summary) -> np.ndarray:
    """(N, 4) float32 [x y z intensity]."""
    scan = frame.load()
    if scan.intensity is None:
        summary.remark("assumed: an intensity of 0, as the clouds have none")
    return scan.points()


def _remark_losses(summary: Summary, placed: Placed, kept: str) -> None:
    """What the layout does not keep, of these words."""
    labels = placed.labels
    for what, there in (("poses", placed.frame.pose() is not None),
                        ("points' labels", placed.frame.point_truth() is not None),
                        ("boxes", len(labels) > 0),
                        ("track ids", bool((labels.track_ids != NO_TRACK).any()))):
        if there and what not in kept:
            summary.remark(f"left out: {what}, for which the layout has no place")


def _kitti_object(folder: Path, frames: Iterator[Placed], summary: Summary) -> Iterator[Placed]:
    for placed in frames:
        frame, calibration = _with_camera(placed.frame, summary)
        write_object_text(folder, placed.number, _cloud(frame, summary),
                          kitti_object.text_of_frame(placed.labels, frame), calibration)
        _remark_losses(summary, placed, "boxes")
        yield placed


def _kitti_tracking(folder: Path, frames: Iterator[Placed], summary: Summary) -> Iterator[Placed]:
    root = folder / "training"
    texts: dict[str, list[str]] = {}
    for placed in frames:
        frame, calibration = _with_camera(placed.frame, summary)
        name = f"{placed.drive:04}"
        write_velodyne(root / f"velodyne/{name}/{placed.index:06}.bin", _cloud(frame, summary))
        if name not in texts:
            write_bytes(root / f"calib/{name}.txt", format_calibration(calibration).encode())
        texts.setdefault(name, []).append(kitti_tracking.text_of_frame(
            placed.labels, frame, placed.index))
        _remark_losses(summary, placed, "boxes, track ids")
        if (placed.labels.track_ids == NO_TRACK).any():
            summary.remark("without a track id, which tracking needs: boxes, written as -1")
        yield placed
    for name, parts in texts.items():
        write_bytes(root / f"label_02/{name}.txt", "".join(parts).encode())


def _semantickitti(folder: Path, frames: Iterator[Placed], summary: Summary) -> Iterator[Placed]:
    drives: dict[int, list[tuple[int, Calibration, np.ndarray | None]]] = {}
    for placed in frames:
        frame, points = placed.frame, placed.frame.point_truth()
        if points is None:
            raise InputError(f"frame {frame.name} has no labels of points, of which SemanticKITTI "
                             "is made; take kitti, kitti-tracking or nuscenes for boxes")
        before = drives.setdefault(placed.drive, [])
        semantickitti.write_scan(folder / f"sequences/{placed.drive:02}", len(before),
                                 _cloud(frame, summary), points.classes, points.instances)
        _remark_losses(summary, placed, "points' labels, poses")
        before.append((frame.stamp_ns, frame.calibration() or NO_CAMERA, frame.pose()))
        yield placed
    for drive, rows in drives.items():
        (start, calibration, _), root = rows[0], folder / f"sequences/{drive:02}"
        times = "".join(f"{(stamp - start) / 1e9:.6e}\n" for stamp, _, _ in rows)
        poses = [pose for _, _, pose in rows if pose is not None]
        write_bytes(root / "calib.txt", semantickitti.format_calibration(calibration).encode())
        write_bytes(root / "times.txt", times.encode())
        if len(poses) == len(rows):
            to_first = np.linalg.inv(poses[0])
            write_bytes(root / "poses.txt", "".join(semantickitti.format_pose(
                to_first @ pose, calibration) for pose in poses).encode())
        elif poses:
            summary.remark("left out: poses, as not every frame of the drive has one")


def _nuscenes(folder: Path, frames: Iterator[Placed], summary: Summary) -> Iterator[Placed]:
    tables = NuscenesTables(folder)
    for placed in frames:
        frame, labels = placed.frame, placed.labels
        if frame.pose() is None:
            summary.remark("assumed: a vehicle that stands, as there are no poses")
        for name in sorted(set(labels.class_names) & LIKE.keys()):
            summary.remark(f"written as another class: {name} as {LIKE[name]}")
        tables.add(frame, labels, placed.drive, _cloud(frame, summary))
        _remark_losses(summary, placed, "boxes, poses, track ids")
        yield placed
    tables.write()


LAYOUTS: dict[str, Callable[[Path, Iterator[Placed], Summary], Iterator[Placed]]] = {
    "kitti": _kitti_object, "kitti-tracking": _kitti_tracking, "nuscenes": _nuscenes,
    "semantickitti": _semantickitti}
