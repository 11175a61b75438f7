"""SemanticKITTI folders: KITTI odometry scans with a class and an instance for every point."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.frame import POINT_LABELS, POSES, Frame, PointTruth, Recording, nothing
from lidar_perception.data.kitti import odometry
from lidar_perception.data.kitti.folder import read_velodyne
from lidar_perception.data.kitti.write import numbers, write_velodyne
from lidar_perception.data.records import read_records
from lidar_perception.runs.files import write_bytes
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
    """Return True for a folder of KITTI odometry, see odometry.recognises, with labels."""
    return odometry.recognises(path) and any(
        (sequence / "labels").is_dir() for sequence in odometry.sequences_of(path))


def open_recording(path: Path, *, points: str = "", scans: bool = True) -> Recording:
    """Open the labelled scans, in order; only the file lists and the times are read. Sequences
    without a labels folder, as the test ones, are left out."""
    sequences = [sequence for sequence in odometry.sequences_of(path)
                 if (sequence / "labels").is_dir() and any(sequence.glob("velodyne/*.bin"))]
    if not sequences:
        raise InputError(f"{path} has labels but no SemanticKITTI scans: expected "
                         "sequences/00/velodyne/*.bin beside sequences/00/labels/*.label")
    frames, timed = odometry.frames_of(sequences)
    posed = any(map(odometry.pose_file, sequences))
    return Recording(path, "SemanticKITTI", [_labelled(frame) for frame in frames],
                     frozenset({POINT_LABELS} | ({POSES} if posed else set())), timed=timed)


def _labelled(frame: Frame) -> Frame:
    """The frame with the labels of its points, which are scored all around: without its camera."""
    scan = frame.points
    assert scan is not None
    label = scan.parents[1] / f"labels/{scan.stem}.label"
    return replace(frame, point_truth=partial(_point_truth, scan, label), calibration=nothing,
                   image=None)


def _point_truth(scan: Path, path: Path) -> PointTruth:
    """Labels of the usable points. InputError where a file is missing, cut or of another scan."""
    cloud = read_velodyne(scan)
    labels = read_records(path, "label", np.uint32)[:, 0]  # class below, instance in the upper half
    if len(labels) != len(cloud):
        raise InputError(f"{path} has {len(labels)} labels for the {len(cloud)} points of {scan}; "
                         "download both again")
    labels = labels.compress(usable_returns(cloud[:, :3]))
    return PointTruth((labels & 0xFFFF).astype(np.uint16), (labels >> 16).astype(np.uint16))


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
