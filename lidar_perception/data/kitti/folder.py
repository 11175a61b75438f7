"""KITTI's object and tracking layouts."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.frame import BOXES, CAMERA, Frame, Recording
from lidar_perception.data.kitti.calibration import read_calibration
from lidar_perception.data.kitti.labels import read_object_labels, read_tracking_labels
from lidar_perception.data.recorded_scale import make_scale_reader
from lidar_perception.data.records import read_records
from lidar_perception.runs.files import read_text
from lidar_perception.types import GroundTruth, InputError, PointCloud
from lidar_perception.wire.topics import LIDAR_FRAME

START_NS = 1_316_995_200 * 10**9  # 26 September 2011, the first day of KITTI's recordings
PERIOD_NS = 10**8  # the sensor rotates at 10 Hz
GAP_NS = 10 * 10**9  # time inserted between the drives of a recording
OBJECT_DATA = "object data"  # name of the layout with unrelated frames
SCAN_FOLDERS = ("velodyne_reduced", "velodyne")  # names of scan folders; the last one, with full scans, is preferred


def read_velodyne(path: Path) -> np.ndarray:
    """Read a .bin file, (N, 4) float32 [x y z reflectance]."""
    return read_records(path, "x y z reflectance")


def load_velodyne(path: Path, stamp_ns: int, scale: Callable[[], float]) -> PointCloud:
    """Load the usable points of a .bin file; scale() returns the value of a full reflection."""
    return PointCloud.of(read_velodyne(path), None, stamp_ns, LIDAR_FRAME, scale())


def make_velodyne_scale_reader(scans: Sequence[Path]) -> Callable[[], float]:
    """Return a function that infers the intensity scale of .bin files, see make_scale_reader.

    The scale is 1 for KITTI's scans, but may differ for other recordings in the same layout.
    """
    return make_scale_reader(scans, lambda path: (read_velodyne(path)[:, 3], np.dtype(np.float32)))


def can_open(path: Path) -> bool:
    """Return True for a folder in the object or tracking layout, even without scans."""
    return any((folder / name).is_dir() for folder in (path / "training", path) for name in (*SCAN_FOLDERS, "label_2"))


def open_layout(path: Path, *, points: str = "", scans: bool = True) -> Recording:
    """Open a folder in the object or tracking layout, in order of time.

    Only the file lists and the frame numbers of labels are read.

    Args:
        path: folder with velodyne/, or its parent with training/.
        scans: False to include frames of the object layout that have labels but no scan.

    Raises:
        InputError: the folder has no scans.
    """
    names = SCAN_FOLDERS if scans else (*SCAN_FOLDERS, "label_2")
    folder = next(
        (folder for folder in (path / "training", path) if any((folder / name).is_dir() for name in names)), path
    )
    is_tracking = (folder / "label_02").is_dir() or any(any(folder.glob(f"{name}/*/")) for name in SCAN_FOLDERS)
    frames = _make_tracking_frames(folder) if is_tracking else _make_object_frames(folder, scans)
    if not frames:
        raise InputError(
            f"{path} has no KITTI scans: expected training/velodyne/*.bin (object) or "
            "training/velodyne/0000/*.bin (tracking)"
        )
    has_labels = (folder / "label_02").is_dir() or (folder / "label_2").is_dir()
    missing_scans = (
        _find_missing_tracking_scans(folder, frames)
        if is_tracking
        else [
            (label.stem, str(label))
            for label in sorted(folder.glob("label_2/*.txt"))
            if not any((folder / name / f"{label.stem}.bin").exists() for name in SCAN_FOLDERS)
        ]
    )
    return Recording(
        path,
        f"KITTI {'tracking data' if is_tracking else OBJECT_DATA}",
        frames,
        frozenset({CAMERA} | ({BOXES} if has_labels else set())),
        tuple((name, f"{label} has no scan; download it again") for name, label in missing_scans) if scans else (),
        is_sequential=is_tracking,
    )


def _find_missing_tracking_scans(folder: Path, frames: list[Frame]) -> list[tuple[str, str]]:
    scan_keys = {(frame.sequence, frame.index) for frame in frames}
    missing_scans = []
    for label in sorted(folder.glob("label_02/*.txt")):
        numbers = {
            int(number)
            for line in read_text(label, noun="the labels").splitlines()
            if (number := line.partition(" ")[0]).isdecimal()
        }
        missing_scans += [
            (f"{label.stem}/{number:06}", f"frame {number} of {label}")
            for number in sorted(numbers)
            if (label.stem, number) not in scan_keys
        ]
    return missing_scans


def _make_object_frames(folder: Path, scans: bool) -> list[Frame]:
    files = {} if scans else {p.stem: folder / f"velodyne/{p.stem}.bin" for p in folder.glob("label_2/*.txt")}
    files |= {p.stem: p for name in SCAN_FOLDERS for p in folder.glob(f"{name}/*.bin")}
    frames, scale = [], make_velodyne_scale_reader([points for _, points in sorted(files.items())])
    for i, (name, points) in enumerate(sorted(files.items())):
        image, label = folder / f"image_2/{name}.png", folder / f"label_2/{name}.txt"
        calib = folder / f"calib/{name}.txt"
        calibration = functools.cache(partial(read_calibration, calib, image))
        stamp = START_NS + i * PERIOD_NS
        frames.append(
            Frame(
                name,
                stamp,
                partial(load_velodyne, points, stamp, scale),
                partial(_read_object_truth, label, calibration),
                calibration=calibration,
                index=i,
                points=points,
                image=image,
                intensity_max=scale,
                files=(points, label, calib),
            )
        )
    return frames


def _read_object_truth(label: Path, calibration: Callable[[], Calibration]) -> GroundTruth | None:
    return read_object_labels(label, calibration().lidar_to_camera) if label.exists() else None


def _make_tracking_frames(folder: Path) -> list[Frame]:
    frames, start = [], START_NS
    drives = {
        drive.name: sorted(drive.glob("*.bin")) for name in SCAN_FOLDERS for drive in sorted(folder.glob(f"{name}/*/"))
    }
    scale = make_velodyne_scale_reader([scan for _, scans in sorted(drives.items()) for scan in scans])
    for name, scans in sorted(drives.items()):
        images = folder / "image_02" / name
        calib, label = folder / f"calib/{name}.txt", folder / f"label_02/{name}.txt"
        calibration = functools.cache(
            partial(read_calibration, calib, images / f"{scans[0].stem}.png" if scans else None)
        )
        truth = make_truth_reader(label, partial(_read_tracking_truth, calibration))
        for points in scans:
            number = parse_scan_number(points)
            stamp = start + (number - parse_scan_number(scans[0])) * PERIOD_NS
            frames.append(
                Frame(
                    f"{name}/{points.stem}",
                    stamp,
                    partial(load_velodyne, points, stamp, scale),
                    partial(truth, number),
                    calibration=calibration,
                    sequence=name,
                    index=number,
                    points=points,
                    image=images / f"{points.stem}.png",
                    intensity_max=scale,
                    files=(points, label, calib),
                )
            )
        start = frames[-1].stamp_ns + GAP_NS if frames else start
    return frames


def _read_tracking_truth(calibration: Callable[[], Calibration], label: Path) -> dict[int, GroundTruth]:
    return read_tracking_labels(label, calibration().lidar_to_camera)


def make_truth_reader(
    path: Path, read: Callable[[Path], dict[int, GroundTruth]]
) -> Callable[[int], GroundTruth | None]:
    """Return a function that returns the labels of a frame, given its number.

    The label file of the drive is read once. If it does not exist, the function returns None.
    """
    labels = functools.cache(partial(read, path))

    def read_truth(number: int) -> GroundTruth | None:
        return labels().get(number, _NO_OBJECTS) if path.exists() else None

    return read_truth


def parse_scan_number(scan: Path) -> int:
    """Return the number in the file name of a scan. Raises InputError if the name is not a number."""
    try:
        return int(scan.stem)
    except ValueError:
        raise InputError(
            f"{scan} is not a KITTI scan: its file name is not a number; move it to another folder"
        ) from None


_NO_OBJECTS = GroundTruth.of([], [])
