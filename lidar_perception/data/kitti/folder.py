"""KITTI folders: the 3D-object and tracking layouts, frame by frame."""

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
from lidar_perception.data.recorded_scale import recorded_scale
from lidar_perception.data.records import read_records
from lidar_perception.runs.files import read_text
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


def load_velodyne(path: Path, stamp_ns: int, scale: Callable[[], float]) -> LidarFrame:
    """Return the usable points of a .bin file; scale() is the value of a full reflection."""
    return LidarFrame.of(read_velodyne(path), None, stamp_ns, LIDAR_FRAME, scale())


def velodyne_scale(scans: Sequence[Path]) -> Callable[[], float]:
    """Return the recorded_scale() of .bin files: 1 for KITTI's; own recordings in its layout may
    have another one."""
    return recorded_scale(scans, lambda path: (read_velodyne(path)[:, 3], np.dtype(np.float32)))


def recognises(path: Path) -> bool:
    """Return True for a folder of the object or tracking layout, or labels that wait for one."""
    return any((folder / name).is_dir() for folder in (path / "training", path)
               for name in (*SCANS, "label_2"))


def open_recording(path: Path, *, points: str = "", scans: bool = True) -> Recording:
    """Open a 3D-object or tracking folder (with velodyne/, or its parent with training/), in order
    of time; nothing is read but the file lists, and which frames the labels are of.

    Without scans, labels are enough to make a frame in the object layout: its points may not exist.
    InputError names the missing folders.
    """
    known = SCANS if scans else (*SCANS, "label_2")
    folder = next((folder for folder in (path / "training", path)
                   if any((folder / name).is_dir() for name in known)), path)
    tracking = (folder / "label_02").is_dir() or any(
        any(folder.glob(f"{name}/*/")) for name in SCANS)
    frames = _tracking(folder) if tracking else _object(folder, scans)
    if not frames:
        raise InputError(f"{path} has no KITTI scans: expected training/velodyne/*.bin (object) or "
                         "training/velodyne/0000/*.bin (tracking)")
    labelled = (folder / "label_02").is_dir() or (folder / "label_2").is_dir()
    lost = _lost_of_tracking(folder, frames) if tracking else _lost_of_object(folder)
    return Recording(path, f"KITTI {'tracking data' if tracking else OBJECT}", frames,
                     frozenset({CAMERA} | ({BOXES} if labelled else set())),
                     tuple((name, f"{label} has no scan; download it again")
                           for name, label in lost) if scans else (), drives=tracking)


def _lost_of_object(folder: Path) -> list[tuple[str, str]]:
    return [(label.stem, str(label)) for label in sorted(folder.glob("label_2/*.txt"))
            if not any((folder / name / f"{label.stem}.bin").exists() for name in SCANS)]


def _lost_of_tracking(folder: Path, frames: list[Frame]) -> list[tuple[str, str]]:
    """Frames that have labels and no scan, with the file of their labels."""
    known = {(frame.sequence, frame.index) for frame in frames}
    lost = []
    for label in sorted(folder.glob("label_02/*.txt")):
        numbers = {int(number) for line in read_text(label, what="the labels").splitlines()
                   if (number := line.partition(" ")[0]).isdecimal()}
        lost += [(f"{label.stem}/{number:06}", f"frame {number} of {label}")
                 for number in sorted(numbers) if (label.stem, number) not in known]
    return lost


def _object(folder: Path, scans: bool) -> list[Frame]:
    files = {} if scans else {p.stem: folder / f"velodyne/{p.stem}.bin"
                              for p in folder.glob("label_2/*.txt")}
    files |= {p.stem: p for name in SCANS for p in folder.glob(f"{name}/*.bin")}
    frames, scale = [], velodyne_scale([points for _, points in sorted(files.items())])
    for i, (name, points) in enumerate(sorted(files.items())):
        image, label = folder / f"image_2/{name}.png", folder / f"label_2/{name}.txt"
        calib = folder / f"calib/{name}.txt"
        calibration = functools.cache(partial(read_calibration, calib, image))
        stamp = START_NS + i * PERIOD_NS
        frames.append(Frame(name, stamp, partial(load_velodyne, points, stamp, scale),
                            partial(_object_truth, label, calibration), calibration=calibration,
                            index=i, points=points, image=image,
                            intensity_max=scale, files=(points, label, calib)))
    return frames


def _object_truth(label: Path, calibration: Callable[[], Calibration]) -> GroundTruth | None:
    return read_object_labels(label, calibration().lidar_to_camera) if label.exists() else None


def _tracking(folder: Path) -> list[Frame]:
    frames, start = [], START_NS
    drives = {drive.name: sorted(drive.glob("*.bin")) for name in SCANS
              for drive in sorted(folder.glob(f"{name}/*/"))}
    scale = velodyne_scale([scan for _, scans in sorted(drives.items()) for scan in scans])
    for name, scans in sorted(drives.items()):
        images = folder / "image_02" / name
        calib, label = folder / f"calib/{name}.txt", folder / f"label_02/{name}.txt"
        calibration = functools.cache(partial(
            read_calibration, calib, images / f"{scans[0].stem}.png" if scans else None))
        truth = truth_by_number(label, partial(_tracking_truth, calibration))
        for points in scans:
            number = number_of(points)
            stamp = start + (number - number_of(scans[0])) * PERIOD_NS
            frames.append(Frame(f"{name}/{points.stem}", stamp,
                                partial(load_velodyne, points, stamp, scale),
                                partial(truth, number), calibration=calibration,
                                sequence=name, index=number, points=points,
                                image=images / f"{points.stem}.png",
                                intensity_max=scale, files=(points, label, calib)))
        start = frames[-1].stamp_ns + GAP_NS if frames else start
    return frames


def _tracking_truth(calibration: Callable[[], Calibration], label: Path
                    ) -> dict[int, GroundTruth]:
    return read_tracking_labels(label, calibration().lidar_to_camera)


def truth_by_number(path: Path, read: Callable[[Path], dict[int, GroundTruth]]
                     ) -> Callable[[int], GroundTruth | None]:
    """Return a function that gives the labels of a frame by its number, from the file of its drive,
    which is read once; None where there is no file."""
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


_NO_OBJECTS = GroundTruth.of([], [])
