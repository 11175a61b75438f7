"""A small drive for the tests of bags, and what a bag holds."""

from __future__ import annotations

import numpy as np
from samples import CALIBRATION, STAMP, scene, walker_truth

from lidar_perception.camera import Calibration
from lidar_perception.data.bag import Bag
from lidar_perception.data.to_bag import Scan
from lidar_perception.wire.topics import CAMERA_INFO, EXTRINSICS, TF_STATIC

OTHER_CALIBRATION = Calibration(CALIBRATION.intrinsics * [[2], [2], [1]],
                                     CALIBRATION.lidar_to_camera, 640, 480)
LATCHED = {CAMERA_INFO, EXTRINSICS, TF_STATIC}


def scans(count: int = 3) -> list[Scan]:
    """Truth in all but the second; the calibration changes after the second."""
    return [Scan(scene(i), STAMP + i * 10**8, None if i == 1 else walker_truth(),
                 CALIBRATION if i < 2 else OTHER_CALIBRATION) for i in range(count)]


def message_bytes(path) -> list[tuple[str, int, bytes]]:
    with Bag(path) as bag:
        return list(bag.raw())


def same_cloud(cloud: np.ndarray, xyz: np.ndarray) -> bool:
    return cloud[:, :3].tobytes() == xyz.tobytes()
