"""Simulated drives as scans for a bag, with a camera like KITTI's."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lidar_perception.datasets.kitti_calibration import KittiCalibration
from lidar_perception.datasets.to_bag import Scan
from lidar_perception.simulation.drive import drive
from lidar_perception.types import GroundTruth

# A camera of KITTI's field of view, level, 0.27 m ahead of the LiDAR and 0.08 m below it.
FORWARD_CAMERA = KittiCalibration(
    intrinsics=np.array([[720.0, 0, 621, 0], [0, 720, 187.5, 0], [0, 0, 1, 0]]),
    lidar_to_camera=np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]]),
    width=1242, height=375)


def simulated_scans(seed: int, frames: int) -> Iterator[Scan]:
    """The scans of a drive with the forward camera and, as in KITTI, labels of the objects whose
    centre it sees."""
    camera = FORWARD_CAMERA.camera()
    for frame, labels in drive(seed, frames):
        seen = np.flatnonzero(camera.in_view(labels.boxes[:, :3]))
        truth = GroundTruth.of(labels.boxes[seen], labels.class_ids[seen],
                               [labels.extras[i] for i in seen])
        cloud = np.column_stack([frame.xyz, frame.intensity])
        yield Scan(cloud, frame.stamp_ns, truth, FORWARD_CAMERA)
