"""SemanticKITTI folders: KITTI odometry scans with a class and an instance for every point."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.frame import POINT_LABELS, POSES, Frame, PointTruth, Recording
from lidar_perception.data.kitti.calibration import homogeneous, matrices, matrix
from lidar_perception.data.kitti.folder import (
    GAP_NS,
    PERIOD_NS,
    START_NS,
    load_velodyne,
    number_of,
    read_velodyne,
    velodyne_scale,
)
from lidar_perception.data.kitti.write import numbers, write_velodyne
from lidar_perception.data.records import read_records
from lidar_perception.runs.files import regular, write_bytes
from lidar_perception.types import InputError, usable_returns

UNLABELLED = (0, 1)  # unlabelled; outlier, such as a reflection: nobody knows what these points are
# road, parking, sidewalk, other-ground, lane-marking, terrain
GROUND = (40, 44, 48, 49, 60, 72)
VEGETATION = 70      # from grass to tree tops, so neither ground nor not ground as a whole
# Classes with instances. The moving ones (252 to 259) are the same things under another number.
THINGS = {10: "car", 11: "bicycle", 13: "bus", 15: "motorcycle", 16: "on-rails", 18: "truck",
          20: "other-vehicle", 30: "person", 31: "bicyclist", 32: "motorcyclist"}
MOVING = {252: 10, 253: 31, 254: 30, 255: 32, 256: 16, 257: 13, 258: 18, 259: 20}


def recognises(path: Path) -> bool:
    """Whether a SemanticKITTI folder lies there, or its sequences/, or a sequence."""
    return (any((path / folder).is_dir() for folder in ("sequences", "dataset/sequences"))
            or any((sequence / "labels").is_dir() and (sequence / "velodyne").is_dir()
                   for sequence in (path, *path.glob("*/"))))


def open_recording(path: Path, *, points: str = "", scans: bool = True) -> Recording:
    """The labelled scans of PATH/sequences/NN or PATH/dataset/sequences/NN, in order; only the
    file lists are read. PATH may also be sequences/ or one sequence. Sequences without a labels
    folder, as the test ones, are left out. InputError says what is missing."""
    sequences = [(s, files) for s in _sequences(path.absolute())
                 if (files := sorted(s.glob("velodyne/*.bin")))]
    if not sequences:
        raise InputError(f"{path} has no SemanticKITTI scans: expected "
                         "sequences/00/velodyne/*.bin beside sequences/00/labels/*.label")
    scale = velodyne_scale([scan for _, files in sequences for scan in files])
    frames: list[Frame] = []
    for sequence, files in sequences:
        if not (sequence / "labels").is_dir():
            continue
        start = frames[-1].stamp_ns + GAP_NS if frames else START_NS
        poses = cache(partial(_poses, sequence))
        for scan in files:
            number = number_of(scan)
            stamp = start + (number - number_of(files[0])) * PERIOD_NS
            frames.append(Frame(
                f"{sequence.name}/{scan.stem}", stamp, partial(load_velodyne, scan, stamp, scale),
                point_truth=partial(_point_truth, scan, sequence / f"labels/{scan.stem}.label"),
                pose=partial(_pose, poses, number), sequence=sequence.name, index=number,
                points=scan, intensity_max=scale,
                native=sequence / "poses.txt"))
    if not frames:
        raise InputError(f"{path} has scans but no labels: expected "
                         "sequences/00/labels/*.label; download the labels of SemanticKITTI too")
    posed = any(frame.native.is_file() for frame in frames)
    return Recording(path, "SemanticKITTI", frames,
                     frozenset({POINT_LABELS} | ({POSES} if posed else set())))


def _sequences(root: Path) -> list[Path]:
    for folder in (root / "dataset/sequences", root / "sequences"):
        if folder.is_dir():
            return sorted(folder.glob("*/"))
    return [root] if (root / "labels").is_dir() else sorted(root.glob("*/"))


def _point_truth(scan: Path, path: Path) -> PointTruth:
    """Labels of the usable points. InputError where a file is missing, cut or of another scan."""
    cloud = read_velodyne(scan)
    labels = read_records(path, "label", np.uint32)[:, 0]  # class below, instance in the upper half
    if len(labels) != len(cloud):
        raise InputError(f"{path} has {len(labels)} labels for the {len(cloud)} points of {scan}; "
                         "download both again")
    labels = labels.compress(usable_returns(cloud[:, :3]))
    return PointTruth((labels & 0xFFFF).astype(np.uint16), (labels >> 16).astype(np.uint16))


def _poses(sequence: Path) -> tuple[np.ndarray, Path, list[str]] | None:
    """(4, 4) the LiDAR's frame in the camera's, and poses.txt with its lines; None without it.
    InputError for files that are not as they should be."""
    poses, calibration = sequence / "poses.txt", sequence / "calib.txt"
    if not poses.is_file():
        return None
    to_camera = homogeneous(matrix(matrices(calibration), calibration, "Tr", (3, 4)))
    try:
        return to_camera, poses, regular(poses).read_text().splitlines()
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {poses} ({error}); download it again") from None


def _pose(poses: Callable[[], tuple[np.ndarray, Path, list[str]] | None],
          i: int) -> np.ndarray | None:
    """(4, 4) the LiDAR's frame of scan number i in that of scan 0, as pose_line wrote it; None
    without poses.txt. InputError also for a line that is none, or not there."""
    if (read := poses()) is None:
        return None
    to_camera, path, lines = read
    try:
        moved = np.array(lines[i].split(), float).reshape(3, 4)
    except (ValueError, IndexError) as error:
        raise InputError(f"cannot read pose {i} of {path} ({error}); download it again") from None
    return np.linalg.inv(to_camera) @ homogeneous(moved) @ to_camera


def write_scan(folder: Path, number: int, cloud: np.ndarray, semantic: np.ndarray,
               instance: np.ndarray) -> None:
    """velodyne and labels of one scan of a sequence's folder: cloud (N, 4), semantic and instance
    (N,) below 65536."""
    labels = np.asarray(instance, np.uint32) << 16 | np.asarray(semantic, np.uint32)
    write_velodyne(folder / f"velodyne/{number:06}.bin", cloud)
    write_bytes(folder / f"labels/{number:06}.label", labels.tobytes())


def pose_line(pose: np.ndarray, calibration: Calibration) -> str:
    """The line of poses.txt of a scan; pose (4, 4) is the LiDAR's frame in that of the first scan
    of the sequence, the file has the camera's."""
    to_camera = calibration.lidar_to_camera
    moved = to_camera @ pose @ np.linalg.inv(to_camera)
    return numbers(moved[:3] + 0.0) + "\n"  # no -0


def calibration_text(calibration: Calibration) -> str:
    """calib.txt: the projections of the four cameras, all the same one, and the LiDAR's pose."""
    rows = {**{f"P{i}": calibration.intrinsics for i in range(4)},
            "Tr": calibration.lidar_to_camera[:3]}
    return "".join(f"{name}: {numbers(matrix)}\n" for name, matrix in rows.items())
