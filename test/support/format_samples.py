"""Drives without files and synthetic labels, for the tests of formats."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from samples import INTRINSICS, LIDAR_TO_CAMERA

from lidar_perception.camera import Calibration
from lidar_perception.data.frame import Frame
from lidar_perception.labels.drive_labels import DriveLabels, FrameLabels
from lidar_perception.labels.exchange import export_labels
from lidar_perception.types import PointCloud

CALIBRATION = Calibration(INTRINSICS, LIDAR_TO_CAMERA, 1242, 375)
DRIVES = {"one": ("0000",), "several": ("0003", "0011")}
NOTES = ("openlabel", "mcap", "mcap-labels")
KITTI = ("kitti", "kitti-tracking")
# A car, and the direction of its heading.
BOX = np.array([10.0, 5.0, -1.0, 4.0, 1.8, 1.5, 2.0])
HEADING = np.array([math.cos(2.0), math.sin(2.0), 0.0])
# Rounding error of each format, metres and radians.
EXACT = {
    "kitti": 2e-6,
    "kitti-tracking": 2e-6,
    "openlabel": 1e-12,
    "nuscenes-detection": 1e-9,
    "nuscenes-tracking": 1e-9,
    "labelcloud": 1e-8,
    "labelcloud-rel": 1e-8,
    "labelcloud-vertices": 5e-8,
    "sustech": 1e-12,
    "mcap": 1e-12,
    "mcap-labels": 1e-12,
}


def make_sloped_pose(i: int) -> np.ndarray:
    """Return the pose of the LiDAR in frame i, on a slope."""
    yaw, pitch = 0.1 * i, 0.02
    about_z = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    about_y = np.array([[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = about_z @ about_y, [100 + 2.0 * i, -50, 3]
    return matrix


def make_format_drive(name: str, frames: int = 3, camera: bool = True) -> list[Frame]:
    """Return frames of each sequence of a drive; numbers start at 5."""
    rng = np.random.default_rng(0)
    drive_frames = []
    for s, sequence in enumerate(DRIVES[name]):
        for i in range(5, 5 + frames):
            stamp = 1_700_000_000_000_000_000 + (100 * s + i) * 100_000_000
            xyz = rng.uniform(-20, 20, (50, 3)).astype(np.float32)
            drive_frames.append(
                Frame.of(
                    f"{sequence}/{i:06}",
                    PointCloud.of(xyz, None, stamp, "velodyne"),
                    calibration=CALIBRATION if camera else None,
                    pose=make_sloped_pose(i).copy,
                    sequence=sequence,
                    index=i,
                )
            )
    return drive_frames


def make_labels(frames: list[Frame], format: str, seed: int = 0) -> DriveLabels:
    """Return boxes around the sensor with all fields that a format keeps; the second frame has
    none."""
    rng = np.random.default_rng(seed)
    names = ["Car", "Pedestrian", "Van", "Cyclist", "e-scooter"]
    found = []
    for number, frame in enumerate(frames):
        count = 0 if number == 1 else 4
        boxes = np.column_stack(
            [
                rng.uniform(-40, 40, (count, 2)),
                rng.uniform(-2, 1, count),
                rng.uniform(0.3, 5, (count, 3)),
                rng.uniform(-math.pi, math.pi, count),
            ]
        )
        ids = np.array([3, 17, 2**31 + 5, -1])[:count]
        scores = [0.25, float("nan"), 1.0, 0.123456][:count]
        extra = [{"occluded": 2, "obj_attr": "dark, ünder a tree", "seen": {"by": [1, "two"]}}] * count
        notes = [("DontCare", {"bbox": [1.0, 2.0, 3.0, 4.0]})] * (format in NOTES)
        if format == "kitti":
            ids = np.full(count, -1)
        found.append(
            FrameLabels.of(
                frame.name, frame.stamp_ns, boxes, rng.choice(names, count).tolist(), ids, scores, extra, notes
            )
        )
    return DriveLabels(found)


def assert_equal_labels(labels: DriveLabels, others: DriveLabels, tolerance: float) -> None:
    """Assert equal labels in any order, with boxes within the tolerance."""
    assert [f.name for f in labels.frames] == [f.name for f in others.frames]
    assert [f.stamp_ns for f in labels.frames] == [f.stamp_ns for f in others.frames]
    for a, b in zip(labels.frames, others.frames):
        one, other = (np.lexsort(f.boxes[:, :3].round(3).T) for f in (a, b))
        difference = a.boxes[one] - b.boxes[other]
        difference[:, 6] = (difference[:, 6] + math.pi) % (2 * math.pi) - math.pi
        assert np.abs(difference).max(initial=0) <= tolerance
        assert [a.class_names[i] for i in one] == [b.class_names[i] for i in other]
        np.testing.assert_array_equal(a.track_ids[one], b.track_ids[other])
        np.testing.assert_allclose(a.scores[one], b.scores[other], rtol=0, atol=5e-7)


def make_one_frame() -> list[Frame]:
    return make_format_drive("one", frames=1)


def export_box(format: str, path: Path, box: np.ndarray = BOX, **more) -> Path:
    """Write the labels of one frame with one car."""
    (frame,) = frames = make_one_frame()
    labels = FrameLabels.of(frame.name, frame.stamp_ns, [box], ["Car"], [7], [0.5], **more)
    export_labels(DriveLabels([labels]), format, path, frames)
    return path


def assert_same_points(found: np.ndarray, expected: np.ndarray) -> None:
    """Assert that two sets of points are the same, in any order."""
    np.testing.assert_allclose(np.sort(np.round(found, 5), axis=0), np.sort(np.round(expected, 5), axis=0), atol=1e-5)
