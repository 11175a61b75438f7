"""Pinhole camera and its calibration relative to the LiDAR."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.spatial.transform import Rotation

from lidar_perception.types import InputError

MAX_PIXELS = 1 << 20  # maximum width or height of an image


@dataclass(frozen=True)
class Camera:
    """Pinhole camera for points in the LiDAR frame.

    Attributes:
        projection: (3, 4) float64, maps homogeneous LiDAR points to pixels times depth.
        width, height: size of the image in pixels.
    """

    projection: np.ndarray
    width: int
    height: int

    def __post_init__(self) -> None:
        if not (np.isfinite(self.projection).all() and 0 < self.width < MAX_PIXELS and 0 < self.height < MAX_PIXELS):
            raise InputError(
                f"the camera calibration is invalid: a value is not finite, or the image size {self.width} x "
                f"{self.height} is out of range; calibrate the camera again"
            )

    @staticmethod
    def from_camera_pose(
        intrinsics: np.ndarray, rotation: np.ndarray, translation: np.ndarray, width: int, height: int
    ) -> Camera:
        """Make a camera from its intrinsics and its pose in the LiDAR frame.

        Args:
            intrinsics: (3, 4) matrix P, as in CameraInfo or KITTI.
            rotation: quaternion [x y z w] of the optical frame (x right, y down, z forward), as in
                TF.
            translation: (3,) metres.
            width, height: size of the image in pixels.
        """
        to_lidar = Rotation.from_quat(rotation)
        return Camera.from_lidar_pose(
            intrinsics, to_lidar.inv().as_quat(), -to_lidar.inv().apply(translation), width, height
        )

    @staticmethod
    def from_lidar_pose(
        intrinsics: np.ndarray, rotation: np.ndarray, translation: np.ndarray, width: int, height: int
    ) -> Camera:
        """Make a camera from its intrinsics (3, 4) and the pose of the LiDAR in the camera frame.

        The arguments have the same form as in from_camera_pose.
        """
        lidar_to_camera = np.eye(4)
        lidar_to_camera[:3, :3] = Rotation.from_quat(rotation).as_matrix()
        lidar_to_camera[:3, 3] = translation
        with np.errstate(invalid="ignore", over="ignore"):  # Camera checks the result
            projection = np.asarray(intrinsics, float).reshape(3, 4) @ lidar_to_camera
        return Camera(projection, int(width), int(height))

    def in_view(self, xyz: np.ndarray) -> np.ndarray:
        """Return (N,) bool: True for points (N, 3) in front of the camera and inside the image."""
        return _in_view(np.ascontiguousarray(xyz), self.projection, self.width, self.height)

    def in_regions(self, xyz: np.ndarray, regions: np.ndarray) -> np.ndarray:
        """Return (N,) bool: True for points (N, 3) in front of the camera and inside any region.

        Args:
            regions: (R, 4) [left top right bottom] in pixels; they may extend beyond the image.
        """
        u, v, depth = (np.asarray(xyz, np.float64) @ self.projection[:, :3].T + self.projection[:, 3]).T
        is_inside = np.zeros(len(xyz), bool)
        for left, top, right, bottom in np.reshape(regions, (-1, 4)):
            is_inside |= (left * depth <= u) & (u < right * depth) & (top * depth <= v) & (v < bottom * depth)
        return is_inside & (depth > 0)


@njit(cache=True, nogil=True)
def _in_view(xyz, projection, width, height):
    p = projection
    in_view = np.empty(len(xyz), np.bool_)
    for i in range(len(xyz)):
        x, y, z = np.float64(xyz[i, 0]), np.float64(xyz[i, 1]), np.float64(xyz[i, 2])
        depth = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
        u = p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]
        v = p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]
        in_view[i] = 0 <= u < width * depth and 0 <= v < height * depth  # implies depth > 0
    return in_view


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibration of a camera.

    Attributes:
        intrinsics: (3, 4), P2 in KITTI.
        lidar_to_camera: (4, 4) transform of LiDAR points to the rectified camera frame
            (R0_rect Tr_velo_to_cam in KITTI).
        width, height: size of the image in pixels.
    """

    intrinsics: np.ndarray
    lidar_to_camera: np.ndarray
    width: int
    height: int

    @property
    def pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Pose of the camera in the LiDAR frame: quaternion [x y z w], translation (3,)."""
        to_lidar = Rotation.from_matrix(self.lidar_to_camera[:3, :3].T)
        return to_lidar.as_quat(), -to_lidar.apply(self.lidar_to_camera[:3, 3])

    def equals(self, other: Calibration | None) -> bool:
        """Return True if the other calibration has the same values."""
        return other is not None and all(
            np.array_equal(a, b) for a, b in zip(vars(self).values(), vars(other).values())
        )

    def camera(self) -> Camera:
        """Return the camera with this calibration."""
        rotation, translation = self.pose
        return Camera.from_camera_pose(self.intrinsics, rotation, translation, self.width, self.height)


# Nominal camera of the simulator and of recordings without one: KITTI's field of view, level,
# 0.27 m ahead of the LiDAR and 0.08 m below it.
FORWARD_CAMERA = Calibration(
    intrinsics=np.array([[720.0, 0, 621, 0], [0, 720, 187.5, 0], [0, 0, 1, 0]]),
    lidar_to_camera=np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]]),
    width=1242,
    height=375,
)
