"""Reader of KITTI's calibration files in the object, tracking, odometry and raw layouts.

Geiger et al., CVPR 2012 and IJRR 2013; the readme files of the development kits define the
matrices.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.runs.files import read_text
from lidar_perception.types import InputError

# Focal length of a recording day -> size of its rectified images, which the calibration files of the
# object and tracking benchmarks do not store.
IMAGE_SIZES = {
    721.5377: (1242, 375),
    707.0493: (1224, 370),
    718.3351: (1238, 374),
    707.0912: (1226, 370),
    718.856: (1241, 376),
}
RAW_CALIB = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt")
MAX_SKEW = 0.01  # maximum element of R R^T - I for a rounded rotation matrix R


def read_calibration(path: Path, image: Path | None = None) -> Calibration:
    """Read calib/*.txt of the object and tracking benchmarks.

    Args:
        image: PNG file that gives the image size, if it exists.

    Raises:
        InputError: a matrix is missing or invalid.
    """
    values = read_matrices(path)
    intrinsics = get_matrix(values, path, "P2", (3, 4))
    rectify = get_matrix(values, path, "R0_rect", (3, 3), "R_rect")
    velodyne = get_matrix(values, path, "Tr_velo_to_cam", (3, 4), "Tr_velo_cam")
    size = _read_png_size(image) or _guess_image_size(intrinsics)
    return Calibration(intrinsics, _make_pose(path, rectify, velodyne), *size)


def read_odometry_calibration(path: Path, image: Path | None = None) -> Calibration:
    """Read calib.txt of a sequence of the odometry benchmark.

    Tr is the pose of the LiDAR in the rectified camera frame. Arguments and errors are as in
    read_calibration.
    """
    values = read_matrices(path)
    intrinsics = get_matrix(values, path, "P2", (3, 4))
    size = _read_png_size(image) or _guess_image_size(intrinsics)
    lidar_to_camera = to_homogeneous(get_matrix(values, path, "Tr", (3, 4)))
    return Calibration(intrinsics, check_pose(lidar_to_camera, path), *size)


def read_raw_calibration(day: Path) -> Calibration:
    """Read the calibration (RAW_CALIB) of a day of raw recordings."""
    cameras, lidar = (day / name for name in RAW_CALIB)
    values, pose = read_matrices(cameras), read_matrices(lidar)
    velodyne = np.column_stack([get_matrix(pose, lidar, "R", (3, 3)), get_matrix(pose, lidar, "T", (3,))])
    width, height = get_matrix(values, cameras, "S_rect_02", (2,)).astype(int).tolist()
    rectify = get_matrix(values, cameras, "R_rect_00", (3, 3))
    return Calibration(
        get_matrix(values, cameras, "P_rect_02", (3, 4)), _make_pose(day, rectify, velodyne), width, height
    )


def read_matrices(path: Path) -> dict[str, np.ndarray]:
    """Read the numbers of each line "NAME: ..." of a file. Raises InputError if it cannot be read."""
    values = {}
    for line in read_text(path, noun="the calibration").splitlines():
        # Some names in the tracking benchmark have no colon.
        name, _, rest = line.replace(":", " ", 1).strip().partition(" ")
        try:
            values[name] = np.array(rest.split(), float)
        except ValueError:
            continue  # other entries, such as calib_time
    return values


def get_matrix(values: dict, path: Path, name: str, shape: tuple[int, ...], alternative: str = "") -> np.ndarray:
    """Return the matrix with a name or an alternative name.

    Raises InputError if it is missing or invalid.
    """
    matrix = values.get(name, values.get(alternative))
    if matrix is None or matrix.size != np.prod(shape) or not np.isfinite(matrix).all():
        raise InputError(
            f"{path} has no {name} with {int(np.prod(shape))} finite numbers; download KITTI's calibration again"
        )
    return matrix.reshape(shape)


def _make_pose(path: Path, rectify: np.ndarray, velodyne: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) of the LiDAR in the rectified camera frame."""
    return check_pose(to_homogeneous(rectify) @ to_homogeneous(velodyne), path)


def check_pose(pose: np.ndarray, path: Path) -> np.ndarray:
    """Return a pose (4, 4) from a file; raise InputError if it is not rigid."""
    rotation = pose[:3, :3]
    if not (
        np.isfinite(pose).all()
        and np.allclose(rotation @ rotation.T, np.eye(3), atol=MAX_SKEW)
        and np.linalg.det(rotation) > 0
    ):
        raise InputError(f"a pose in {path} is not a rigid transform; download the file again")
    return pose


def to_homogeneous(matrix: np.ndarray) -> np.ndarray:
    """Extend a matrix (3, 3) or (3, 4) to (4, 4)."""
    result = np.eye(4)
    result[:3, : matrix.shape[1]] = matrix
    return result


def _read_png_size(image: Path | None) -> tuple[int, int] | None:
    if image is None or not image.exists():
        return None
    with open(image, "rb") as stream:
        head = stream.read(24)
    return struct.unpack(">II", head[16:24]) if head[:4] == b"\x89PNG" and len(head) == 24 else None


def _guess_image_size(intrinsics: np.ndarray) -> tuple[int, int]:
    focal = min(IMAGE_SIZES, key=lambda length: abs(length - intrinsics[0, 0]))
    return IMAGE_SIZES[focal] if abs(focal - intrinsics[0, 0]) < 0.01 else (1242, 375)
