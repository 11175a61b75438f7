"""A small drive for the tests of bags."""

from __future__ import annotations

import io
import shutil
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import yaml
from rosbags.convert.converter import convert
from rosbags.typesys import Stores, get_typestore
from samples import CALIBRATION, STAMP, make_scene, make_walker_truth

from lidar_perception.camera import Calibration
from lidar_perception.data.bag import Bag
from lidar_perception.data.frame import Frame
from lidar_perception.types import PointCloud
from lidar_perception.wire.topics import CAMERA_INFO, EXTRINSICS, TF_STATIC

OTHER_CALIBRATION = Calibration(CALIBRATION.intrinsics * [[2], [2], [1]], CALIBRATION.lidar_to_camera, 640, 480)
LATCHED = {CAMERA_INFO, EXTRINSICS, TF_STATIC}


def scans(count: int = 3) -> list[Frame]:
    """Return frames, all but the second with labels; the calibration changes after the second."""
    return [
        Frame.of(
            str(i),
            cloud_frame(make_scene(i), STAMP + i * 10**8),
            None if i == 1 else make_walker_truth(),
            CALIBRATION if i < 2 else OTHER_CALIBRATION,
        )
        for i in range(count)
    ]


def cloud_frame(cloud: np.ndarray, stamp_ns: int) -> PointCloud:
    """Return a frame of cloud (N, 4) [x y z intensity]."""
    return PointCloud(np.ascontiguousarray(cloud[:, :3]), cloud[:, 3].copy(), stamp_ns, "velodyne")


def message_bytes(path) -> list[tuple[str, int, bytes]]:
    with Bag(path) as bag:
        return list(bag.raw_messages())


def same_cloud(cloud: np.ndarray, xyz: np.ndarray) -> bool:
    return cloud[:, :3].tobytes() == xyz.tobytes()


def as_ros1(source: Path, path: Path, compress: str | None = None) -> Path:
    """Convert a bag to ROS 1 and return its path; `compress` is lz4, bz2 or None."""
    with redirect_stdout(io.StringIO()):
        convert([source], path, "", 0, compress, "", None, get_typestore(Stores.ROS1_NOETIC), (), (), (), ())
    return path


def copy_with_metadata(bag: Path, folder: Path, change) -> Path:
    """Return a copy of the bag with changed metadata.yaml."""
    shutil.copytree(bag, folder)
    metadata = yaml.safe_load((folder / "metadata.yaml").read_text())
    change(metadata["rosbag2_bagfile_information"])
    (folder / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    return folder
