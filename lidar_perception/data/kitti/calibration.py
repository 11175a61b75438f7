"""KITTI calibration files of the object, tracking and raw layouts.

Geiger et al., CVPR 2012 and IJRR 2013; the development kits' readme files define the matrices.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.runs.files import read_text
from lidar_perception.types import InputError

# Size of the rectified images by focal length: it differs with the recording day, and the object
# and tracking calibration files do not say it.
IMAGE_SIZES = {721.5377: (1242, 375), 707.0493: (1224, 370), 718.3351: (1238, 374),
               707.0912: (1226, 370), 718.856: (1241, 376)}
RAW_CALIB = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt")
MAX_SKEW = 0.01  # of a rotation that was rounded


def read_calibration(path: Path, image: Path | None = None) -> Calibration:
    """calib/*.txt of the object and tracking benchmarks. The image, where there is one, gives
    the size. InputError names the file and the missing matrix."""
    values = matrices(path)
    intrinsics = matrix(values, path, "P2", (3, 4))
    rectify = matrix(values, path, "R0_rect", (3, 3), "R_rect")
    velodyne = matrix(values, path, "Tr_velo_to_cam", (3, 4), "Tr_velo_cam")
    size = _png_size(image) or _size_by_focal_length(intrinsics)
    return Calibration(intrinsics, _pose(path, rectify, velodyne), *size)


def read_odometry_calibration(path: Path, image: Path | None = None) -> Calibration:
    """Read calib.txt of a sequence of the odometry benchmark, whose Tr is the pose of the LiDAR in
    the rectified camera frame. Image and errors as in read_calibration."""
    values = matrices(path)
    intrinsics = matrix(values, path, "P2", (3, 4))
    size = _png_size(image) or _size_by_focal_length(intrinsics)
    return Calibration(intrinsics, rigid(homogeneous(matrix(values, path, "Tr", (3, 4))), path),
                       *size)


def read_raw_calibration(day: Path) -> Calibration:
    """RAW_CALIB of a raw recording day."""
    cameras, lidar = (day / name for name in RAW_CALIB)
    values, pose = matrices(cameras), matrices(lidar)
    velodyne = np.column_stack([matrix(pose, lidar, "R", (3, 3)), matrix(pose, lidar, "T", (3,))])
    width, height = matrix(values, cameras, "S_rect_02", (2,)).astype(int).tolist()
    rectify = matrix(values, cameras, "R_rect_00", (3, 3))
    return Calibration(matrix(values, cameras, "P_rect_02", (3, 4)),
                            _pose(day, rectify, velodyne), width, height)


def matrices(path: Path) -> dict[str, np.ndarray]:
    """The numbers of each line "NAME: ..." of a file. InputError where it cannot be read."""
    values = {}
    for line in read_text(path, what="the calibration").splitlines():
        # the tracking benchmark writes some names without a colon
        name, _, rest = line.replace(":", " ", 1).strip().partition(" ")
        try:
            values[name] = np.array(rest.split(), float)
        except ValueError:
            continue  # calib_time and the like
    return values


def matrix(values: dict, path: Path, name: str, shape: tuple[int, ...],
           other: str = "") -> np.ndarray:
    """The one of a name, or else of another. InputError, naming the file, if it is not there."""
    found = values.get(name, values.get(other))
    if found is None or found.size != np.prod(shape) or not np.isfinite(found).all():
        raise InputError(f"{path} has no {name} of {int(np.prod(shape))} finite numbers; download "
                         "KITTI's calibration again")
    return found.reshape(shape)


def _pose(path: Path, rectify: np.ndarray, velodyne: np.ndarray) -> np.ndarray:
    """(4, 4) LiDAR into the rectified camera frame."""
    return rigid(homogeneous(rectify) @ homogeneous(velodyne), path)


def rigid(pose: np.ndarray, path: Path) -> np.ndarray:
    """Return a pose (4, 4) that a file gives. InputError, naming the file, if it is no rotation and
    translation."""
    turn = pose[:3, :3]
    if not (np.isfinite(pose).all() and np.allclose(turn @ turn.T, np.eye(3), atol=MAX_SKEW)
            and np.linalg.det(turn) > 0):
        raise InputError(f"a pose in {path} is no rotation; download it again")
    return pose


def homogeneous(matrix: np.ndarray) -> np.ndarray:
    """(4, 4) of (3, 3) or (3, 4)."""
    full = np.eye(4)
    full[:3, :matrix.shape[1]] = matrix
    return full


def _png_size(image: Path | None) -> tuple[int, int] | None:
    if image is None or not image.exists():
        return None
    with open(image, "rb") as stream:
        head = stream.read(24)
    return struct.unpack(">II", head[16:24]) if head[:4] == b"\x89PNG" and len(head) == 24 else None


def _size_by_focal_length(intrinsics: np.ndarray) -> tuple[int, int]:
    focal = min(IMAGE_SIZES, key=lambda known: abs(known - intrinsics[0, 0]))
    return IMAGE_SIZES[focal] if abs(focal - intrinsics[0, 0]) < 0.01 else (1242, 375)
