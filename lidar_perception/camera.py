"""The camera's view of the LiDAR frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Camera:
    """projection (3, 4) float64: homogeneous LiDAR points to pixels times depth; width and
    height of the image in pixels."""

    projection: np.ndarray
    width: int
    height: int

    @staticmethod
    def of(intrinsics: np.ndarray, rotation: np.ndarray, translation: np.ndarray, width: int,
           height: int) -> Camera:
        """From P (3, 4) of CameraInfo or KITTI and the camera's pose in the LiDAR frame, as TF
        has it: rotation a quaternion [x y z w], translation (3,) metres. The camera frame is
        optical: x right, y down, z forward."""
        to_lidar = Rotation.from_quat(rotation)
        return Camera.of_lidar_pose(intrinsics, to_lidar.inv().as_quat(),
                                    -to_lidar.inv().apply(translation), width, height)

    @staticmethod
    def of_lidar_pose(intrinsics: np.ndarray, rotation: np.ndarray, translation: np.ndarray,
                      width: int, height: int) -> Camera:
        """As of(), from the LiDAR's pose in the camera frame."""
        lidar_to_camera = np.eye(4)
        lidar_to_camera[:3, :3] = Rotation.from_quat(rotation).as_matrix()
        lidar_to_camera[:3, 3] = translation
        return Camera(np.asarray(intrinsics, float).reshape(3, 4) @ lidar_to_camera, int(width),
                      int(height))

    def in_view(self, xyz: np.ndarray) -> np.ndarray:
        """(N,) bool: points (N, 3) in front of the camera that fall into the image."""
        # float32 keeps this to one pass over the cloud; it is good to 0.01 pixel.
        u, v, depth = (self.projection[:, :3].astype(np.float32) @ xyz.T
                       + self.projection[:, 3:].astype(np.float32))
        return ((depth > 0) & (u >= 0) & (u < self.width * depth)
                & (v >= 0) & (v < self.height * depth))
