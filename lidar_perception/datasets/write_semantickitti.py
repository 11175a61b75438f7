"""Labelled scans into SemanticKITTI's layout; semantickitti.py reads them back.

Behley et al., ICCV 2019; the layout of scans, poses, times and calib is that of KITTI's odometry
benchmark.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lidar_perception.datasets.kitti_calibration import KittiCalibration
from lidar_perception.datasets.write_kitti import numbers, write_velodyne
from lidar_perception.files import write_bytes


def write_scan(folder: Path, number: int, cloud: np.ndarray, semantic: np.ndarray,
               instance: np.ndarray) -> None:
    """velodyne and labels of one scan of a sequence's folder: cloud (N, 4), semantic and instance
    (N,) below 65536."""
    labels = np.asarray(instance, np.uint32) << 16 | np.asarray(semantic, np.uint32)
    write_velodyne(folder / f"velodyne/{number:06}.bin", cloud)
    write_bytes(folder / f"labels/{number:06}.label", labels.tobytes())


def pose_line(pose: np.ndarray, calibration: KittiCalibration) -> str:
    """The line of poses.txt of a scan; pose (4, 4) is the LiDAR's frame in that of the first scan
    of the sequence, the file has the camera's."""
    to_camera = calibration.lidar_to_camera
    moved = to_camera @ pose @ np.linalg.inv(to_camera)
    return numbers(moved[:3] + 0.0) + "\n"  # no -0


def calibration_text(calibration: KittiCalibration) -> str:
    """calib.txt: the projections of the four cameras, all the same one, and the LiDAR's pose."""
    rows = {**{f"P{i}": calibration.intrinsics for i in range(4)},
            "Tr": calibration.lidar_to_camera[:3]}
    return "".join(f"{name}: {numbers(matrix)}\n" for name, matrix in rows.items())
