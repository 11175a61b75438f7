"""KITTI-360 recordings: raw scans of the Velodyne, poses, and the calibration of the left camera.

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
from lidar_perception.data.frame import CAMERA, POSES, Recording, return_none
from lidar_perception.data.kitti import raw
from lidar_perception.data.kitti.calibration import check_pose, get_matrix, read_matrices, to_homogeneous
from lidar_perception.runs.files import read_text
from lidar_perception.types import InputError

SCAN_FOLDER, CALIBRATION_FOLDER, POSE_FILES = "data_3d_raw", "calibration", ("cam0_to_world.txt", "poses.txt")


def can_open(path: Path) -> bool:
    """Return True for the folder with data_3d_raw/, for data_3d_raw/, and for a drive in it."""
    return _find_root(path) is not None


def _find_root(path: Path) -> Path | None:
    path = path.absolute()
    return next(
        (
            folder
            for folder in (path, *path.parents[:2])
            if (folder / SCAN_FOLDER).is_dir() and (folder == path or path.relative_to(folder).parts[0] == SCAN_FOLDER)
        ),
        None,
    )


def open_layout(path: Path, *, points: str = "", scans: bool = True) -> Recording:
    """Open the scans of all drives in order of time; only file lists and time stamps are read.

    Poses are read from data_poses/ and the camera from calibration/, if these folders exist.
    """
    root = _find_root(path)
    assert root is not None
    opened_path = path.absolute()
    drives = sorted(
        data.parents[1]
        for data in (root / SCAN_FOLDER).glob(f"*/{raw.SCAN_FOLDER}")
        if opened_path in (*data.parents, root / SCAN_FOLDER)
    )
    frames, has_times = raw.make_frames(drives)
    if not frames:
        raise InputError(f"{path} has no KITTI-360 scans: expected {SCAN_FOLDER}/DRIVE/{raw.SCAN_FOLDER}/*.bin")
    has_calibration = (root / CALIBRATION_FOLDER).is_dir()
    poses = {drive.name: cache(partial(_read_poses, root, drive.name)) for drive in drives}
    has_poses = has_calibration and any(_find_pose_file(root, name) for name in poses)
    calibration = cache(partial(_read_calibration, root)) if has_calibration else return_none
    image = "data_2d_raw/{}/image_00/data_rect/{}.png"
    return Recording(
        path,
        "KITTI-360",
        [
            replace(
                frame,
                calibration=calibration,
                pose=partial(_get_pose, poses[frame.sequence], frame.index) if has_poses else return_none,
                image=root / image.format(frame.sequence, frame.name.rpartition("/")[2]),
                files=(),
            )
            for frame in frames
        ],
        frozenset([CAMERA] * has_calibration + [POSES] * has_poses),
        has_times=has_times,
    )


def _read_calibration(root: Path) -> Calibration:
    """Return the calibration of the rectified left camera."""
    path = root / CALIBRATION_FOLDER / "perspective.txt"
    values = read_matrices(path)
    width, height = get_matrix(values, path, "S_rect_00", (2,)).astype(int).tolist()
    lidar_to_camera = _read_rectification(root) @ np.linalg.inv(_read_camera_to_lidar(root))
    return Calibration(get_matrix(values, path, "P_rect_00", (3, 4)), lidar_to_camera, width, height)


def _read_rectification(root: Path) -> np.ndarray:
    """Return the transform (4, 4) from the left camera to the rectified one."""
    path = root / CALIBRATION_FOLDER / "perspective.txt"
    rotation = get_matrix(read_matrices(path), path, "R_rect_00", (3, 3))
    return check_pose(to_homogeneous(rotation), path)


def _read_camera_to_lidar(root: Path) -> np.ndarray:
    """Return the transform (4, 4) from the left camera to the LiDAR."""
    path = root / CALIBRATION_FOLDER / "calib_cam_to_velo.txt"
    return check_pose(to_homogeneous(_read_rows(path, 12)[0].reshape(3, 4)), path)


def _find_pose_file(root: Path, drive: str) -> Path | None:
    files = [root / "data_poses" / drive / name for name in POSE_FILES]
    return next((file for file in files if file.is_file()), None)


def _read_poses(root: Path, drive: str) -> dict[int, np.ndarray]:
    """Return the poses (4, 4) of the LiDAR in the world, by frame number."""
    path = _find_pose_file(root, drive)
    if path is None:
        return {}
    to_camera = np.linalg.inv(_read_camera_to_lidar(root))
    if path.name == POSE_FILES[0]:  # this file has the poses of the rectified camera
        rectify = _read_rectification(root)
        return {
            int(row[0]): check_pose(row[1:].reshape(4, 4), path) @ rectify @ to_camera for row in _read_rows(path, 17)
        }
    mount = root / CALIBRATION_FOLDER / "calib_cam_to_pose.txt"
    camera_mount = get_matrix(read_matrices(mount), mount, "image_00", (3, 4))
    to_vehicle = check_pose(to_homogeneous(camera_mount), mount)
    return {
        int(row[0]): check_pose(to_homogeneous(row[1:].reshape(3, 4)), path) @ to_vehicle @ to_camera
        for row in _read_rows(path, 13)
    }


def _get_pose(poses: Callable[[], dict[int, np.ndarray]], number: int) -> np.ndarray | None:
    return poses().get(number)


def _read_rows(path: Path, columns: int) -> np.ndarray:
    """Read rows of numbers, (N, columns). Raises InputError if a row has another format."""
    rows = [line.split() for line in read_text(path, noun="the matrices").splitlines()]
    try:
        matrix = np.array([row for row in rows if row], float).reshape(-1, columns)
    except ValueError:
        matrix = np.full((0, columns), np.nan)
    if not (len(matrix) and np.isfinite(matrix).all()):
        raise InputError(f"{path} has a line without {columns} finite numbers; download it again")
    return matrix
