"""KITTI-360 folders: raw scans of the Velodyne, with poses and the calibration of the left camera.

Liao et al., TPAMI 2022; the scripts at github.com/autonomousvision/kitti360Scripts define the
matrices.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.frame import CAMERA, POSES, Recording, nothing
from lidar_perception.data.kitti import raw
from lidar_perception.data.kitti.calibration import homogeneous, matrices, matrix, rigid
from lidar_perception.runs.files import read_text
from lidar_perception.types import InputError

SCANS, CALIBRATION, POSE_FILES = "data_3d_raw", "calibration", ("cam0_to_world.txt", "poses.txt")


def recognises(path: Path) -> bool:
    """Return True for the folder with data_3d_raw/, for data_3d_raw/, and for a drive in it."""
    return _root(path) is not None


def _root(path: Path) -> Path | None:
    path = path.absolute()
    return next((folder for folder in (path, *path.parents[:2]) if (folder / SCANS).is_dir()
                 and (folder == path or path.relative_to(folder).parts[0] == SCANS)), None)


def open_recording(path: Path, *, points: str = "", scans: bool = True) -> Recording:
    """Open the scans of the drives, in order of time, with poses from data_poses/ and the camera of
    calibration/ where they are; only the file lists and the time stamps are read."""
    root = _root(path)
    assert root is not None
    here = path.absolute()
    drives = sorted(data.parents[1] for data in (root / SCANS).glob(f"*/{raw.DATA}")
                    if here in (*data.parents, root / SCANS))
    frames, timed = raw.frames_of(drives)
    if not frames:
        raise InputError(f"{path} has no KITTI-360 scans: expected {SCANS}/DRIVE/{raw.DATA}/*.bin")
    calibrated = (root / CALIBRATION).is_dir()
    poses = {drive.name: cache(partial(_poses, root, drive.name)) for drive in drives}
    posed = calibrated and any(_pose_file(root, name) for name in poses)
    calibration = cache(partial(_calibration, root)) if calibrated else nothing
    image = "data_2d_raw/{}/image_00/data_rect/{}.png"
    return Recording(path, "KITTI-360", [replace(
        frame, calibration=calibration,
        pose=partial(_pose, poses[frame.sequence], frame.index) if posed else nothing,
        image=root / image.format(frame.sequence, frame.name.rpartition("/")[2]), files=())
        for frame in frames], frozenset([CAMERA] * calibrated + [POSES] * posed), timed=timed)


def _calibration(root: Path) -> Calibration:
    """The calibration of the rectified left camera."""
    path = root / CALIBRATION / "perspective.txt"
    values = matrices(path)
    width, height = matrix(values, path, "S_rect_00", (2,)).astype(int).tolist()
    return Calibration(matrix(values, path, "P_rect_00", (3, 4)),
                       _rectify(root) @ np.linalg.inv(_camera_to_lidar(root)), width, height)


def _rectify(root: Path) -> np.ndarray:
    """(4, 4) from the left camera to the rectified one."""
    path = root / CALIBRATION / "perspective.txt"
    return rigid(homogeneous(matrix(matrices(path), path, "R_rect_00", (3, 3))), path)


def _camera_to_lidar(root: Path) -> np.ndarray:
    """(4, 4) from the left camera to the LiDAR."""
    path = root / CALIBRATION / "calib_cam_to_velo.txt"
    return rigid(homogeneous(_rows(path, 12)[0].reshape(3, 4)), path)


def _pose_file(root: Path, drive: str) -> Path | None:
    files = [root / "data_poses" / drive / name for name in POSE_FILES]
    return next((file for file in files if file.is_file()), None)


def _poses(root: Path, drive: str) -> dict[int, np.ndarray]:
    """Number of a frame -> (4, 4) the LiDAR in the world, of those that have a pose."""
    path = _pose_file(root, drive)
    if path is None:
        return {}
    to_camera = np.linalg.inv(_camera_to_lidar(root))
    if path.name == POSE_FILES[0]:  # of the rectified camera
        return {int(row[0]): rigid(row[1:].reshape(4, 4), path) @ _rectify(root) @ to_camera
                for row in _rows(path, 17)}
    mount = root / CALIBRATION / "calib_cam_to_pose.txt"
    to_vehicle = rigid(homogeneous(matrix(matrices(mount), mount, "image_00", (3, 4))), mount)
    return {int(row[0]): rigid(homogeneous(row[1:].reshape(3, 4)), path) @ to_vehicle @ to_camera
            for row in _rows(path, 13)}


def _pose(poses: Callable[[], dict[int, np.ndarray]], number: int) -> np.ndarray | None:
    return poses().get(number)


def _rows(path: Path, columns: int) -> np.ndarray:
    """(N, columns) numbers of a file. InputError for another one."""
    rows = [line.split() for line in read_text(path, what="the matrices").splitlines()]
    try:
        found = np.array([row for row in rows if row], float).reshape(-1, columns)
    except ValueError:
        found = np.full((0, columns), np.nan)
    if not (len(found) and np.isfinite(found).all()):
        raise InputError(f"{path} has a line that is not {columns} finite numbers; download it "
                         "again")
    return found
