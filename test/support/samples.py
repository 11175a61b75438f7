"""Small synthetic inputs that several test files share."""

from __future__ import annotations

import importlib.util
import os
import struct
import time
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidar_perception.camera import Calibration
from lidar_perception.data.frame import Frame
from lidar_perception.data.kitti.labels import format_label, to_labels
from lidar_perception.data.kitti.write import write_object
from lidar_perception.types import CLASSES, PEDESTRIAN, GroundTruth, PointCloud
from lidar_perception.wire.codec import make_bag_message
from msg_utils.messages import make_ros_message
from msg_utils.stamps import make_header


def for_all(cases):
    """Run a test for all cases in one pytest item, because collecting thousands of items takes longer than
    running them. The error names the failing case. A case is an argument, a tuple of arguments, or a
    pytest.param."""

    def of(test):
        def each():
            assert cases
            for case in cases:
                try:
                    test(*getattr(case, "values", case if isinstance(case, tuple) else (case,)))
                except BaseException as error:
                    error.add_note(f"of {getattr(case, 'id', case)}")
                    raise

        each.__name__, each.__doc__, each.__module__ = test.__name__, test.__doc__, test.__module__
        return each

    return of


# Both kinds of message classes: rosbags' own, and ROS's.
each_make = pytest.mark.parametrize(
    "make",
    [
        pytest.param(make_bag_message, id="rosbags"),
        pytest.param(
            make_ros_message,
            id="ros",
            marks=pytest.mark.skipif(
                importlib.util.find_spec("rclpy") is None, reason="needs ROS 2, or the extra [ros]"
            ),
        ),
    ],
)

# Real scans next to the checkout.
DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="no real data next to the checkout (../shared/data)")

STAMP = 1_700_000_000_123_456_789

# A forward-looking camera, almost level, slightly ahead of the LiDAR.
AXES = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # x forward, z up -> x right, y down
RECTIFY = Rotation.from_euler("xyz", [0.004, -0.007, 0.003]).as_matrix()
VELODYNE = np.column_stack(
    [Rotation.from_euler("xyz", [0.002, 0.006, -0.009]).as_matrix() @ AXES, [0.01, -0.08, -0.27]]
)
INTRINSICS = np.array([[721.5377, 0, 609.6, 45.0], [0, 721.5377, 172.9, 0.2], [0, 0, 1, 0.003]])
LIDAR_TO_CAMERA = np.eye(4)
LIDAR_TO_CAMERA[:3] = RECTIFY @ VELODYNE
CALIBRATION = Calibration(INTRINSICS, LIDAR_TO_CAMERA, 1242, 375)

WALKER = np.array([8.0, 0.5, -0.85, 0.5, 0.5, 1.7, 0.3])  # [x y z l w h yaw]
LABELS = """\
Pedestrian 0.00 0 -0.21 700.00 150.00 800.00 300.00 1.80 0.50 0.90 1.50 1.60 8.00 0.02
Car 0.35 2 1.57 10.25 180.50 220.75 374.00 1.52 1.63 3.88 -5.10 1.71 9.43 1.05
DontCare -1 -1 -10 503.89 169.71 590.61 190.13 -1 -1 -1 -1000 -1000 -1000 -10
"""


def make_any_header(make, ns: int = STAMP, frame_id: str = "velodyne"):
    return make_header(ns, frame_id, make)


def make_scene(seed: int = 0) -> np.ndarray:
    """Return flat ground 1.7 m below and a person inside the box WALKER, (N, 4) float32."""
    rng = np.random.default_rng(seed)
    flat = rng.uniform(-20, 20, (3000, 3)) * [1, 1, 0.001] - [0, 0, 1.7]
    person = rng.uniform(-0.15, 0.15, (400, 3)) * [1, 1, 5.5] + WALKER[:3]
    xyz = np.concatenate([flat, person])
    return np.column_stack([xyz, rng.uniform(0, 1, len(xyz))]).astype(np.float32)


def make_walker_truth() -> GroundTruth:
    return GroundTruth.of([WALKER], [PEDESTRIAN])


def make_walker_label() -> str:
    return format_label(to_labels(make_walker_truth(), LIDAR_TO_CAMERA)[0])


def format_numbers(matrix: np.ndarray) -> str:
    return " ".join(f"{v!r}" for v in np.asarray(matrix).ravel().tolist())


def make_calibration_text(rectify: str = "R0_rect:", velodyne: str = "Tr_velo_to_cam:") -> str:
    rows = {"P2:": INTRINSICS, rectify: RECTIFY, velodyne: VELODYNE}
    return "".join(f"{name} {format_numbers(values)}\n" for name, values in rows.items())


def write_file(path: Path, content: str | bytes | np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content.encode() if isinstance(content, str) else bytes(content))
    return path


def make_png_header(width: int, height: int) -> bytes:
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", width, height)


def write_object_folder(root: Path, labels: str = LABELS, count: int = 2) -> Path:
    """Write a KITTI object folder training/{velodyne,calib,label_2} with frames 000000..."""
    for i in range(count):
        write_file(root / f"training/velodyne/{i:06}.bin", make_scene(i).tobytes())
        write_file(root / f"training/calib/{i:06}.txt", make_calibration_text())
        write_file(root / f"training/label_2/{i:06}.txt", labels)
    return root


def make_upright(rng, x: float, y: float, height: float, width: float) -> np.ndarray:
    """Return the visible side of an object (N, 3), with fewer points at larger distances. With negative width it
    is a person, narrow at the head and the feet."""
    away = np.hypot(x, y)
    z, across = (
        m.ravel() for m in np.meshgrid(np.arange(0.02, height, 0.0073 * away), np.arange(-0.5, 0.5, 0.003 * away))
    )
    wide = np.interp(z / height, [0, 0.5, 0.8, 0.85, 1], [0.2, 0.3, 0.5, 0.2, 0.15])
    is_kept = np.abs(across) < (wide / 2 if width < 0 else width / 2)
    side, depth = np.array([-y, x, 0]) / away, np.array([x, y, 0]) / away
    xyz = np.outer(across[is_kept], side) + [x, y, -1.7] + np.outer(z[is_kept], [0, 0, 1])
    return xyz + np.outer(rng.uniform(-0.2, 0.2, len(xyz)), depth)


def make_crowd(seed: int, people: int = 4) -> tuple[np.ndarray, GroundTruth]:
    """Return a cloud (N, 4) float32 and labels: people, posts, boxes and a labelled car without points on flat
    ground 1.7 m below, 6 to 40 m away. No object crosses the range limits 15 and 30 m."""
    rng = np.random.default_rng(seed)
    parts = [rng.uniform([2, -20, -1.7], [50, 20, -1.69], (4000, 3))]
    boxes, ids = [], []

    def somewhere(azimuth):
        away = rng.uniform(*((6, 13.5), (16.5, 28.5), (31.5, 40))[rng.integers(3)])
        return away * np.cos(azimuth), away * np.sin(azimuth)

    for azimuth in rng.permutation(np.linspace(-0.2, 0.2, 5))[:people]:
        (x, y), height = somewhere(azimuth), rng.uniform(1.6, 1.9)
        parts.append(make_upright(rng, x, y, height, -1))
        boxes.append([x, y, height / 2 - 1.7, 0.6, 0.6, height, rng.uniform(-3, 3)])
        ids.append(PEDESTRIAN)
    for width in (0.15, 0.4, 0.4, 0.8, 0.8, 1.0):
        parts.append(
            make_upright(rng, *somewhere(rng.choice([-1, 1]) * rng.uniform(0.3, 0.5)), rng.uniform(1.5, 2.0), width)
        )
    boxes.append([15, 8, -0.95, 4.0, 1.6, 1.5, 0.1])
    ids.append(CLASSES.index("Car"))
    xyz = np.concatenate(parts)
    return np.column_stack([xyz, rng.uniform(0, 1, len(xyz))]).astype(np.float32), GroundTruth.of(boxes, ids)


def make_lowered_crowd(seed: int, by: float) -> Frame:
    """Return the frame of a crowd seen by a sensor that is `by` metres lower, at 0.1 s times the seed."""
    cloud, truth = make_crowd(seed)
    up = np.array([0, 0, by], np.float32)
    scan = PointCloud.of(cloud[:, :3] + up, cloud[:, 3].copy(), 10**9 + seed * 10**8, "velodyne")
    return Frame.of(str(seed), scan, GroundTruth.of(truth.boxes + np.pad(up, (0, 4)), truth.class_ids))


def write_crowd_folder(root: Path, count: int = 6) -> Path:
    """Write a KITTI object folder with crowds of people; the last frame has none."""
    for i in range(count):
        cloud, truth = make_crowd(i, people=4 if i < count - 1 else 0)
        write_object(root, i, cloud, truth, CALIBRATION)
    return root


def wait_for_the_end(group):
    """Wait until all processes of a group have ended."""
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return
        time.sleep(0.02)
    pytest.fail("a process is still there")
