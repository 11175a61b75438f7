"""KITTI odometry: sequences of scans with times, calibration and poses."""

from __future__ import annotations

from collections.abc import Callable
from decimal import Decimal, InvalidOperation
from functools import cache, partial
from pathlib import Path

import numpy as np

from lidar_perception.data.frame import CAMERA, POSES, Frame, Recording, return_none
from lidar_perception.data.kitti.calibration import (
    check_pose,
    get_matrix,
    read_matrices,
    read_odometry_calibration,
    to_homogeneous,
)
from lidar_perception.data.kitti.folder import (
    GAP_NS,
    PERIOD_NS,
    START_NS,
    load_velodyne,
    make_velodyne_scale_reader,
    parse_scan_number,
)
from lidar_perception.runs.files import read_text
from lidar_perception.types import InputError

CALIBRATION_FILE, TIMES_FILE, POSES_FILE = SEQUENCE_FILES = ("calib.txt", "times.txt", "poses.txt")
MIN_UNIX_TIME_S = 10**9  # larger times are Unix times; smaller times count from the start of the sequence


def can_open(path: Path) -> bool:
    """Return True for a folder with sequences/ or dataset/sequences/, for sequences/, or for a single
    sequence."""
    return any((path / folder).is_dir() for folder in ("sequences", "dataset/sequences")) or any(
        map(_is_sequence, (path, *path.glob("*/")))
    )


def _is_sequence(path: Path) -> bool:
    return (path / "velodyne").is_dir() and (
        (path / "labels").is_dir() or any((path / name).is_file() for name in SEQUENCE_FILES)
    )


def list_sequences(path: Path) -> list[Path]:
    """Return the sequence folders at a path that can_open accepts, sorted by name."""
    path = path.absolute()
    for folder in (path / "dataset/sequences", path / "sequences"):
        if folder.is_dir():
            return sorted(folder.glob("*/"))
    return [path] if _is_sequence(path) else sorted(filter(_is_sequence, path.glob("*/")))


def open_layout(path: Path, *, points: str = "", scans: bool = True) -> Recording:
    """Open the scans of sequences/NN/velodyne; only file lists and times are read.

    Poses are read from sequences/NN/poses.txt or poses/NN.txt.
    """
    sequences = [s for s in list_sequences(path) if any(s.glob("velodyne/*.bin"))]
    if not sequences:
        raise InputError(
            f"{path} has no scans of KITTI odometry or SemanticKITTI: expected sequences/00/velodyne/*.bin"
        )
    if not any(map(_is_sequence, sequences)):
        raise InputError(
            f"{path} has scans but no labels: expected sequences/00/labels/*.label of "
            "SemanticKITTI, or calib.txt and times.txt of KITTI odometry; download "
            "them too"
        )
    frames, has_times = make_frames(sequences)
    contents = {POSES} if any(find_pose_file(s) for s in sequences) else set()
    if any((s / CALIBRATION_FILE).is_file() for s in sequences):
        contents.add(CAMERA)
    return Recording(path, "KITTI odometry", frames, frozenset(contents), has_times=has_times)


def make_frames(sequences: list[Path]) -> tuple[list[Frame], bool]:
    """Make the frames of sequences, with a gap of GAP_NS between two sequences.

    Returns:
        The frames, and True if the times of all frames are recorded; otherwise 10 Hz is assumed.
    """
    frames: list[Frame] = []
    has_times = True
    scans = {sequence: sorted(sequence.glob("velodyne/*.bin")) for sequence in sequences}
    scale = make_velodyne_scale_reader([file for files in scans.values() for file in files])
    for sequence, files in scans.items():
        start = frames[-1].stamp_ns + GAP_NS if frames else START_NS
        times = _read_times(sequence / TIMES_FILE)
        has_times = has_times and bool(times)
        poses, calib = cache(partial(_read_poses, sequence)), sequence / CALIBRATION_FILE
        image = sequence / "image_2"
        calibration = (
            cache(partial(read_odometry_calibration, calib, image / f"{files[0].stem}.png"))
            if calib.is_file()
            else return_none
        )
        if times and times[0] > MIN_UNIX_TIME_S * 10**9:
            start = 0
        for scan in files:
            number = parse_scan_number(scan)
            if times and number >= len(times):
                raise InputError(
                    f"{sequence / TIMES_FILE} has only {len(times)} lines, so scan {number} has no time; "
                    "download the file again"
                )
            stamp = start + (times[number] if times else (number - parse_scan_number(files[0])) * PERIOD_NS)
            frames.append(
                Frame(
                    f"{sequence.name}/{scan.stem}",
                    stamp,
                    partial(load_velodyne, scan, stamp, scale),
                    calibration=calibration,
                    pose=partial(_parse_pose, poses, number),
                    sequence=sequence.name,
                    index=number,
                    points=scan,
                    image=image / f"{scan.stem}.png",
                    intensity_max=scale,
                )
            )
    return frames, has_times


def _read_times(path: Path) -> list[int]:
    """Return the times in times.txt (seconds) in ns; empty if the file does not exist."""
    if not path.is_file():
        return []
    try:
        return [int(Decimal(word) * 10**9) for word in read_text(path, noun="the times").split()]
    except (InvalidOperation, ValueError, OverflowError):
        raise InputError(f"{path} has a line that is not a number of seconds; download it again") from None


def find_pose_file(sequence: Path) -> Path | None:
    """Return the pose file of a sequence, or None."""
    files = (sequence / POSES_FILE, sequence.parents[1] / f"poses/{sequence.name}.txt")
    return next((file for file in files if file.is_file()), None)


def _read_poses(sequence: Path) -> tuple[np.ndarray, Path, list[str]] | None:
    """Return the pose (4, 4) of the LiDAR in the camera frame, the pose file and its lines; None without that file."""
    if (poses := find_pose_file(sequence)) is None:
        return None
    calibration = sequence / CALIBRATION_FILE
    to_camera = to_homogeneous(get_matrix(read_matrices(calibration), calibration, "Tr", (3, 4)))
    lines = read_text(poses, noun="the poses").splitlines()
    return check_pose(to_camera, calibration), poses, lines


def _parse_pose(poses: Callable[[], tuple[np.ndarray, Path, list[str]] | None], i: int) -> np.ndarray | None:
    """Return the pose (4, 4) of scan i in the frame of scan 0; None without poses.

    Line i of the file is the pose of the camera. Raises InputError if it is missing or invalid.
    """
    if (content := poses()) is None:
        return None
    to_camera, path, lines = content
    try:
        camera_pose = np.array(lines[i].split(), float).reshape(3, 4)
    except (ValueError, IndexError) as error:
        raise InputError(f"cannot read pose {i} of {path} ({error}); download it again") from None
    return np.linalg.inv(to_camera) @ check_pose(to_homogeneous(camera_pose), path) @ to_camera
