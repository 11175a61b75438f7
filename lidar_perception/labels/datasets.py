"""Conversion of recordings to data sets, with a report of content that the layout cannot store."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data import semantickitti
from lidar_perception.data.frame import Frame
from lidar_perception.data.kitti.folder import GAP_NS, PERIOD_NS
from lidar_perception.data.kitti.write import format_calibration, write_object_text, write_velodyne
from lidar_perception.data.open import write_height
from lidar_perception.labels.datasets_nuscenes import NuscenesTables
from lidar_perception.labels.drive_labels import NO_TRACK, DriveLabels, FrameLabels, read_frame_labels
from lidar_perception.labels.formats import kitti_object, kitti_tracking
from lidar_perception.labels.formats.nuscenes import SIMILAR_NAME_BY_CLASS
from lidar_perception.labels.names import resolve_format
from lidar_perception.runs.files import write_bytes, write_folder
from lidar_perception.simulation.camera import FORWARD_CAMERA
from lidar_perception.types import SENSOR_HEIGHT, InputError

# Camera assumed for a recording without one: level, at the LiDAR, with KITTI's field of view.
ASSUMED_CAMERA = replace(
    FORWARD_CAMERA, lidar_to_camera=np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
)


@dataclass(frozen=True)
class DatasetFrame:
    """Frame with its labels and its position in the data set.

    Attributes:
        frame: Frame of the recording.
        labels: Labels of the frame.
        drive: Number of the drive.
        index: Number of the frame in the drive.
        number: Number of the frame in the data set.
    """

    frame: Frame
    labels: FrameLabels
    drive: int
    index: int
    number: int


@dataclass
class Summary:
    """Counts of a data set.

    Attributes:
        frames: Number of frames.
        boxes: Number of boxes.
        drives: Number of drives.
        remarks: Number of frames to which each omission or assumption applies.
    """

    frames: int = 0
    boxes: int = 0
    drives: int = 0
    remarks: Counter[str] = field(default_factory=Counter)


def write_dataset(
    layout: str, frames: Iterable[Frame], out: Path, labels: DriveLabels | None = None, force: bool = False
) -> Summary:
    """Write the frames of a recording as a data set in one of LAYOUTS.

    Frames are numbered from 0; in KITTI's tracking layout the number is the time in units of 0.1 s.
    A new drive starts at each sequence of the recording, after a gap of 5 s, and when the
    calibration changes. A sensor height that differs from KITTI's is stored, see
    data.open.write_height.

    Args:
        layout: Name of the layout.
        frames: Frames of the recording.
        out: Folder of the data set.
        labels: Labels to write instead of those of the recording.
        force: Replace existing files.

    Raises:
        InputError: A frame cannot be read or written; `out` is then unchanged.
    """
    layout = resolve_format(layout, LAYOUTS)
    summary = Summary()
    with write_folder(out, force) as folder:
        for item in LAYOUTS[layout](folder, _number_frames(frames, labels), summary):
            if item.number == 0 and item.frame.sensor_height != SENSOR_HEIGHT:
                write_height(folder, item.frame.sensor_height)
            summary.frames += 1
            summary.boxes += len(item.labels)
            summary.drives = item.drive + 1
        if summary.frames == 0:
            raise InputError("the recording has no frames; give a recording with clouds")
    return summary


def _number_frames(frames: Iterable[Frame], labels: DriveLabels | None) -> Iterator[DatasetFrame]:
    drive, index, start, previous = -1, 0, 0, None
    for number, frame in enumerate(frames):
        if previous is None or not _continues_drive(previous, frame):
            drive, index, start = drive + 1, -1, frame.stamp_ns
        steps = round((frame.stamp_ns - start) / PERIOD_NS)
        is_periodic = abs(frame.stamp_ns - start - steps * PERIOD_NS) < PERIOD_NS // 4
        index = steps if is_periodic and steps > index else index + 1
        frame_labels = labels.frames[number] if labels is not None else read_frame_labels(frame)
        previous = frame
        yield DatasetFrame(frame, frame_labels, drive, index, number)


def _continues_drive(previous: Frame, frame: Frame) -> bool:
    previous_calibration, calibration = previous.calibration(), frame.calibration()
    same_calibration = previous_calibration is calibration or (
        previous_calibration is not None and previous_calibration.equals(calibration)
    )
    return (
        previous.sequence == frame.sequence
        and same_calibration
        and 0 <= frame.stamp_ns - previous.stamp_ns < GAP_NS // 2
    )


def _ensure_camera(frame: Frame, summary: Summary) -> tuple[Frame, Calibration]:
    """Return the frame and its calibration; if it has none, both use ASSUMED_CAMERA."""
    calibration = frame.calibration()
    if calibration is None:
        summary.remarks["assumed: a forward camera at the LiDAR, because KITTI's labels need a camera"] += 1
        calibration = ASSUMED_CAMERA
    return replace(frame, calibration=lambda: calibration), calibration


def _load_cloud(frame: Frame, summary: Summary) -> np.ndarray:
    scan = frame.load()
    if scan.intensity is None:
        summary.remarks["assumed: an intensity of 0, because the clouds have none"] += 1
    return scan.points()


def _add_loss_remarks(summary: Summary, item: DatasetFrame, stored_content: str) -> None:
    """Add a remark for each kind of content of the frame that is not in `stored_content`."""
    labels = item.labels
    for content, exists in (
        ("poses", item.frame.pose() is not None),
        ("point labels", item.frame.point_truth() is not None),
        ("boxes", len(labels) > 0),
        ("track ids", bool((labels.track_ids != NO_TRACK).any())),
    ):
        if exists and content not in stored_content:
            summary.remarks[f"left out: {content}, which the layout cannot store"] += 1


def _write_kitti_object(folder: Path, frames: Iterator[DatasetFrame], summary: Summary) -> Iterator[DatasetFrame]:
    for item in frames:
        frame, calibration = _ensure_camera(item.frame, summary)
        write_object_text(
            folder, item.number, _load_cloud(frame, summary), kitti_object.format_frame(item.labels, frame), calibration
        )
        _add_loss_remarks(summary, item, "boxes")
        yield item


def _write_kitti_tracking(folder: Path, frames: Iterator[DatasetFrame], summary: Summary) -> Iterator[DatasetFrame]:
    root = folder / "training"
    texts: dict[str, list[str]] = {}
    for item in frames:
        frame, calibration = _ensure_camera(item.frame, summary)
        name = f"{item.drive:04}"
        write_velodyne(root / f"velodyne/{name}/{item.index:06}.bin", _load_cloud(frame, summary))
        if name not in texts:
            write_bytes(root / f"calib/{name}.txt", format_calibration(calibration).encode())
        texts.setdefault(name, []).append(kitti_tracking.format_frame(item.labels, frame, item.index))
        _add_loss_remarks(summary, item, "boxes, track ids")
        if (item.labels.track_ids == NO_TRACK).any():
            summary.remarks["boxes without a track id: written with the id -1"] += 1
        yield item
    for name, parts in texts.items():
        write_bytes(root / f"label_02/{name}.txt", "".join(parts).encode())


def _write_semantickitti(folder: Path, frames: Iterator[DatasetFrame], summary: Summary) -> Iterator[DatasetFrame]:
    drives: dict[int, list[tuple[int, Calibration, np.ndarray | None]]] = {}
    for item in frames:
        frame, points = item.frame, item.frame.point_truth()
        if points is None:
            raise InputError(
                f"frame {frame.name} has no point labels, which SemanticKITTI needs; "
                "use kitti, kitti-tracking or nuscenes for boxes"
            )
        scans = drives.setdefault(item.drive, [])
        semantickitti.write_scan(
            folder / f"sequences/{item.drive:02}",
            len(scans),
            _load_cloud(frame, summary),
            points.classes,
            points.instances,
        )
        _add_loss_remarks(summary, item, "point labels, poses")
        scans.append((frame.stamp_ns, frame.calibration() or ASSUMED_CAMERA, frame.pose()))
        yield item
    for drive, rows in drives.items():
        (start, calibration, _), root = rows[0], folder / f"sequences/{drive:02}"
        times = "".join(f"{(stamp - start) / 1e9:.6e}\n" for stamp, _, _ in rows)
        poses = [pose for _, _, pose in rows if pose is not None]
        write_bytes(root / "calib.txt", semantickitti.format_calibration(calibration).encode())
        write_bytes(root / "times.txt", times.encode())
        if len(poses) == len(rows):
            to_first = np.linalg.inv(poses[0])
            write_bytes(
                root / "poses.txt",
                "".join(semantickitti.format_pose(to_first @ pose, calibration) for pose in poses).encode(),
            )
        elif poses:
            summary.remarks["left out: poses, because some frames of the drive have none"] += 1


def _write_nuscenes(folder: Path, frames: Iterator[DatasetFrame], summary: Summary) -> Iterator[DatasetFrame]:
    tables = NuscenesTables(folder)
    for item in frames:
        frame, labels = item.frame, item.labels
        if frame.pose() is None:
            summary.remarks["assumed: a vehicle that does not move, because the recording has no poses"] += 1
        for name in sorted(set(labels.class_names) & SIMILAR_NAME_BY_CLASS.keys()):
            summary.remarks[f"written as another class: {name} as {SIMILAR_NAME_BY_CLASS[name]}"] += 1
        tables.add(frame, labels, item.drive, _load_cloud(frame, summary))
        _add_loss_remarks(summary, item, "boxes, poses, track ids")
        yield item
    tables.write()


LAYOUTS: dict[str, Callable[[Path, Iterator[DatasetFrame], Summary], Iterator[DatasetFrame]]] = {
    "kitti": _write_kitti_object,
    "kitti-tracking": _write_kitti_tracking,
    "nuscenes": _write_nuscenes,
    "semantickitti": _write_semantickitti,
}
