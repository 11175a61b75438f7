"""SemanticKITTI folders: KITTI odometry scans with a class and an instance for each point."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.frame import POINT_LABELS, POSES, Frame, PointTruth, Recording, return_none
from lidar_perception.data.kitti import odometry
from lidar_perception.data.kitti.folder import read_velodyne
from lidar_perception.data.kitti.write import format_matrices, format_numbers, write_velodyne
from lidar_perception.data.records import read_records
from lidar_perception.runs.files import write_bytes
from lidar_perception.types import InputError, are_usable_returns

UNLABELLED = (0, 1)  # labels "unlabelled" and "outlier" (such as a reflection)
# Labels road, parking, sidewalk, other-ground, lane-marking, terrain.
GROUND = (40, 44, 48, 49, 60, 72)
VEGETATION = 70  # includes grass and tree tops, so it is partly ground
# Classes with instances. MOVING maps the labels of moving objects to these classes.
THINGS = {
    10: "car",
    11: "bicycle",
    13: "bus",
    15: "motorcycle",
    16: "on-rails",
    18: "truck",
    20: "other-vehicle",
    30: "person",
    31: "bicyclist",
    32: "motorcyclist",
}
MOVING = {252: 10, 253: 31, 254: 30, 255: 32, 256: 16, 257: 13, 258: 18, 259: 20}


def can_open(path: Path) -> bool:
    """Return True for a folder of KITTI odometry (see odometry.can_open) with labels."""
    return odometry.can_open(path) and any((sequence / "labels").is_dir() for sequence in odometry.list_sequences(path))


def open_layout(path: Path, *, points: str = "", scans: bool = True) -> Recording:
    """Open the labelled scans in order; only file lists and times are read.

    Sequences without a labels folder, such as the test sequences, are left out.
    """
    sequences = [
        sequence
        for sequence in odometry.list_sequences(path)
        if (sequence / "labels").is_dir() and any(sequence.glob("velodyne/*.bin"))
    ]
    if not sequences:
        raise InputError(
            f"{path} has labels but no SemanticKITTI scans: expected "
            "sequences/00/velodyne/*.bin and sequences/00/labels/*.label"
        )
    frames, has_times = odometry.make_frames(sequences)
    has_poses = any(map(odometry.find_pose_file, sequences))
    return Recording(
        path,
        "SemanticKITTI",
        [_add_point_truth(frame) for frame in frames],
        frozenset({POINT_LABELS} | ({POSES} if has_poses else set())),
        has_times=has_times,
    )


def _add_point_truth(frame: Frame) -> Frame:
    """Add the point labels to a frame, and remove its camera because all points are scored."""
    scan = frame.points
    assert scan is not None
    label = scan.parents[1] / f"labels/{scan.stem}.label"
    return replace(frame, point_truth=partial(_read_point_truth, scan, label), calibration=return_none, image=None)


def _read_point_truth(scan: Path, path: Path) -> PointTruth:
    """Return the labels of the usable points.

    Raises InputError if a file is missing or truncated, or if the numbers of points and labels
    differ.
    """
    cloud = read_velodyne(scan)
    labels = read_records(path, "label", np.uint32)[:, 0]  # upper 16 bits: instance; lower: class
    if len(labels) != len(cloud):
        raise InputError(f"{path} has {len(labels)} labels for the {len(cloud)} points of {scan}; download both again")
    labels = labels.compress(are_usable_returns(cloud[:, :3]))
    return PointTruth((labels & 0xFFFF).astype(np.uint16), (labels >> 16).astype(np.uint16))


def write_scan(folder: Path, number: int, cloud: np.ndarray, semantic: np.ndarray, instance: np.ndarray) -> None:
    """Write a scan and its labels to a sequence folder.

    Args:
        cloud: (N, 4) [x y z reflectance].
        semantic, instance: (N,) class and instance of each point, below 65536.
    """
    labels = np.asarray(instance, np.uint32) << 16 | np.asarray(semantic, np.uint32)
    write_velodyne(folder / f"velodyne/{number:06}.bin", cloud)
    write_bytes(folder / f"labels/{number:06}.label", labels.tobytes())


def format_pose(pose: np.ndarray, calibration: Calibration) -> str:
    """Format the line of a scan in poses.txt, which contains the poses of the camera.

    Args:
        pose: (4, 4) pose of the LiDAR in the frame of the first scan.
        calibration: calibration of the camera.
    """
    to_camera = calibration.lidar_to_camera
    camera_pose = to_camera @ pose @ np.linalg.inv(to_camera)
    return format_numbers(camera_pose[:3] + 0.0) + "\n"  # + 0.0 turns -0 into 0


def format_calibration(calibration: Calibration) -> str:
    """Format calib.txt, with the projections of four identical cameras and the pose of the LiDAR."""
    return format_matrices(calibration, Tr=calibration.lidar_to_camera[:3])
