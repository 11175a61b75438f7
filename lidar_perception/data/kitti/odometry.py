"""KITTI odometry folders: sequences of scans with times, a calibration and poses."""

from __future__ import annotations

from collections.abc import Callable
from decimal import Decimal, InvalidOperation
from functools import cache, partial
from pathlib import Path

import numpy as np

from lidar_perception.data.frame import CAMERA, POSES, Frame, Recording, nothing
from lidar_perception.data.kitti.calibration import (
    homogeneous,
    matrices,
    matrix,
    read_odometry_calibration,
    rigid,
)
from lidar_perception.data.kitti.folder import (
    GAP_NS,
    PERIOD_NS,
    START_NS,
    load_velodyne,
    number_of,
    velodyne_scale,
)
from lidar_perception.runs.files import read_text
from lidar_perception.types import InputError

CALIBRATION, TIMES, POSES_FILE = FILES = ("calib.txt", "times.txt", "poses.txt")
SINCE_1970 = 10**9  # seconds: later times are not counted from the start of the sequence


def recognises(path: Path) -> bool:
    """Return True for a folder with sequences/ or dataset/sequences/, for sequences/, and for one
    sequence."""
    return any((path / folder).is_dir() for folder in ("sequences", "dataset/sequences")) or any(
        map(_is_sequence, (path, *path.glob("*/"))))


def _is_sequence(path: Path) -> bool:
    return (path / "velodyne").is_dir() and (
        (path / "labels").is_dir() or any((path / name).is_file() for name in FILES))


def sequences_of(path: Path) -> list[Path]:
    """List the folders of the sequences at a path that recognises() accepts, in order."""
    path = path.absolute()
    for folder in (path / "dataset/sequences", path / "sequences"):
        if folder.is_dir():
            return sorted(folder.glob("*/"))
    return [path] if _is_sequence(path) else sorted(filter(_is_sequence, path.glob("*/")))


def open_recording(path: Path, *, points: str = "", scans: bool = True) -> Recording:
    """Open the scans of sequences/NN/velodyne, with the poses of sequences/NN/poses.txt or
    poses/NN.txt; only the file lists and the times are read."""
    sequences = [s for s in sequences_of(path) if any(s.glob("velodyne/*.bin"))]
    if not sequences:
        raise InputError(f"{path} has no KITTI odometry scans and no SemanticKITTI scans: expected "
                         "sequences/00/velodyne/*.bin")
    if not any(map(_is_sequence, sequences)):
        raise InputError(f"{path} has scans but no labels: expected sequences/00/labels/*.label of "
                         "SemanticKITTI, or calib.txt and times.txt of KITTI odometry; download "
                         "them too")
    frames, timed = frames_of(sequences)
    has = {POSES} if any(pose_file(s) for s in sequences) else set()
    if any((s / CALIBRATION).is_file() for s in sequences):
        has.add(CAMERA)
    return Recording(path, "KITTI odometry", frames, frozenset(has), timed=timed)


def frames_of(sequences: list[Path]) -> tuple[list[Frame], bool]:
    """Return the frames of sequences with scans, GAP_NS between two, and whether all their times
    are recorded; otherwise 10 Hz is assumed."""
    frames: list[Frame] = []
    timed = True
    scans = {sequence: sorted(sequence.glob("velodyne/*.bin")) for sequence in sequences}
    scale = velodyne_scale([file for files in scans.values() for file in files])
    for sequence, files in scans.items():
        start = frames[-1].stamp_ns + GAP_NS if frames else START_NS
        times = _times(sequence / TIMES)
        timed = timed and bool(times)
        poses, calib = cache(partial(_poses, sequence)), sequence / CALIBRATION
        image = sequence / "image_2"
        calibration = cache(partial(
            read_odometry_calibration, calib, image / f"{files[0].stem}.png")
        ) if calib.is_file() else nothing
        if times and times[0] > SINCE_1970 * 10**9:
            start = 0
        for scan in files:
            number = number_of(scan)
            if times and number >= len(times):
                raise InputError(f"{sequence / TIMES} has {len(times)} lines, and none for scan "
                                 f"{number}; download it again")
            stamp = start + (times[number] if times else
                             (number - number_of(files[0])) * PERIOD_NS)
            frames.append(Frame(
                f"{sequence.name}/{scan.stem}", stamp, partial(load_velodyne, scan, stamp, scale),
                calibration=calibration, pose=partial(_pose, poses, number),
                sequence=sequence.name, index=number, points=scan,
                image=image / f"{scan.stem}.png", intensity_max=scale))
    return frames, timed


def _times(path: Path) -> list[int]:
    """Nanoseconds of the lines of times.txt, which are seconds; empty without this file."""
    if not path.is_file():
        return []
    try:
        return [int(Decimal(word) * 10**9) for word in read_text(path, what="the times").split()]
    except (InvalidOperation, ValueError, OverflowError):
        raise InputError(f"{path} has a line that is no number of seconds; download it again"
                         ) from None


def pose_file(sequence: Path) -> Path | None:
    """Return the file with the poses of a sequence; None where there is none."""
    files = (sequence / POSES_FILE, sequence.parents[1] / f"poses/{sequence.name}.txt")
    return next((file for file in files if file.is_file()), None)


def _poses(sequence: Path) -> tuple[np.ndarray, Path, list[str]] | None:
    """(4, 4) the LiDAR's frame in the camera's, and the file of poses with its lines; None without
    it. InputError for files that are not as they should be."""
    if (poses := pose_file(sequence)) is None:
        return None
    calibration = sequence / CALIBRATION
    to_camera = homogeneous(matrix(matrices(calibration), calibration, "Tr", (3, 4)))
    return rigid(to_camera, calibration), poses, read_text(poses, what="the poses").splitlines()


def _pose(poses: Callable[[], tuple[np.ndarray, Path, list[str]] | None],
          i: int) -> np.ndarray | None:
    """(4, 4) the LiDAR's frame of scan number i in that of scan 0, of the line that has the pose of
    the camera; None without poses. InputError also for a line that is none, or not there."""
    if (read := poses()) is None:
        return None
    to_camera, path, lines = read
    try:
        moved = np.array(lines[i].split(), float).reshape(3, 4)
    except (ValueError, IndexError) as error:
        raise InputError(f"cannot read pose {i} of {path} ({error}); download it again") from None
    return np.linalg.inv(to_camera) @ rigid(homogeneous(moved), path) @ to_camera
