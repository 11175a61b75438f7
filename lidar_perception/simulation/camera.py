"""The camera beside the simulated LiDAR: it takes no pictures, but says what is labelled."""

from __future__ import annotations

import numpy as np

from lidar_perception.datasets.kitti_calibration import KittiCalibration
from lidar_perception.types import GroundTruth

# A camera of KITTI's field of view, level, 0.27 m ahead of the LiDAR and 0.08 m below it.
FORWARD_CAMERA = KittiCalibration(
    intrinsics=np.array([[720.0, 0, 621, 0], [0, 720, 187.5, 0], [0, 0, 1, 0]]),
    lidar_to_camera=np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]]),
    width=1242, height=375)


def labels_in_view(truth: GroundTruth) -> GroundTruth:
    """The objects whose centre FORWARD_CAMERA sees: what KITTI labels."""
    seen = np.flatnonzero(FORWARD_CAMERA.camera().in_view(truth.boxes[:, :3]))
    return GroundTruth.of(truth.boxes[seen], truth.class_ids[seen],
                          [truth.extras[i] for i in seen])
