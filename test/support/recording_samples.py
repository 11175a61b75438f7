"""A small recording in every supported layout."""

from __future__ import annotations

import numpy as np
import nuscenes_folder
import pytest
from bag_samples import scans
from kitti_samples import write_raw_folder, write_tracking_folder
from samples import CALIBRATION, make_scene, write_file, write_object_folder

from lidar_perception.data.frame import BOXES, CAMERA, POINT_LABELS, POSES
from lidar_perception.data.semantickitti import format_calibration, format_pose, write_scan
from lidar_perception.data.to_bag import write_bag


def make_drive_pose(i):
    """Return the pose of scan i of a sequence."""
    yaw, pose = 0.1 * i, np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:3, 3] = [2.0 * i, 0.3 * i, -0.1 * i]
    return pose


def semantic_folder(root):
    """Write two sequences in which every point has a different label."""
    for sequence, count in (("00", 2), ("08", 1)):
        folder = root / "sequences" / sequence
        for i in range(count):
            cloud = make_scene(i)
            write_scan(folder, i, cloud, np.arange(len(cloud)) % 260, np.arange(len(cloud)) % 7)
        write_file(folder / "poses.txt", "".join(format_pose(make_drive_pose(i), CALIBRATION) for i in range(count)))
        write_file(folder / "calib.txt", format_calibration(CALIBRATION))
    return root


def nuscenes_root(root):
    return nuscenes_folder.save(root, nuscenes_folder.make_tables(frames=3, objects=6))


def reduced_folder(root):
    write_tracking_folder(root)
    (root / "training/velodyne").rename(root / "training/velodyne_reduced")
    return root


def bag_folder(root):
    write_bag(root, scans())
    return root


def odometry_folder(root):
    """Write two sequences with times, poses and calibration, as downloaded from KITTI."""
    for sequence, count in (("00", 2), ("11", 1)):
        folder = root / "dataset/sequences" / sequence
        for i in range(count):
            write_file(folder / f"velodyne/{i:06}.bin", make_scene(i).tobytes())
        write_file(folder / "calib.txt", format_calibration(CALIBRATION))
        write_file(folder / "times.txt", "".join(f"{0.1036 * i:e}\n" for i in range(count)))
        write_file(
            root / f"dataset/poses/{sequence}.txt",
            "".join(format_pose(make_drive_pose(i), CALIBRATION) for i in range(count)),
        )
    return root


def kitti360_folder(root):
    """Write scans 0, 1 and 3 of a drive."""
    name = "2013_05_28_drive_0000_sync"
    scans = root / f"data_3d_raw/{name}/velodyne_points"
    for i in (0, 1, 3):
        write_file(scans / f"data/{i:010}.bin", make_scene(i).tobytes())
    write_file(scans / "timestamps.txt", "".join(f"2013-05-28 08:46:02.{i}04700000\n" for i in range(4)))
    return root


def openpcdet_folder(root):
    for i in range(3):
        (root / "points").mkdir(parents=True, exist_ok=True)
        np.save(root / f"points/{i:06}.npy", make_scene(i))
        write_file(root / f"labels/{i:06}.txt", "12.0 0.0 -0.98 3.9 1.6 1.5 0.1 Vehicle\n")
    write_file(root / "ImageSets/train.txt", "000000\n000002\n")
    return root


def cloud_folder(root):
    for i in (1, 2, 10):  # in numeric order
        write_file(root / f"scan{i}.bin", make_scene(i).astype(np.float32).tobytes())
    return root


MADE = {  # name: (writer, inner paths that are the same recording, description, content)
    "object": (write_object_folder, ("", "training"), "KITTI object data, 2 frames", {BOXES, CAMERA}),
    "tracking": (write_tracking_folder, ("", "training"), "KITTI tracking data, 5 frames", {BOXES, CAMERA}),
    "reduced": (reduced_folder, ("", "training"), "KITTI tracking data, 5 frames", {BOXES, CAMERA}),
    "raw": (
        write_raw_folder,
        ("", "2011_09_26", "2011_09_26/2011_09_26_drive_0001_sync"),
        "KITTI raw drives, 3 frames",
        {BOXES, CAMERA},
    ),
    "nuscenes": (nuscenes_root, ("", nuscenes_folder.VERSION), "nuScenes v1.0-mini, 6 frames", {BOXES, POSES}),
    "semantickitti": (semantic_folder, ("", "sequences"), "SemanticKITTI, 3 frames", {POINT_LABELS, POSES}),
    "odometry": (odometry_folder, ("", "dataset", "dataset/sequences"), "KITTI odometry, 3 frames", {CAMERA, POSES}),
    "kitti360": (
        kitti360_folder,
        ("", "data_3d_raw", "data_3d_raw/2013_05_28_drive_0000_sync"),
        "KITTI-360, 3 frames",
        set(),
    ),
    "openpcdet": (openpcdet_folder, ("",), "OpenPCDet custom data, 3 frames", {BOXES}),
    "bag": (bag_folder, ("", "bag.mcap"), "rosbag2 bag, clouds on /points, 3 frames", {BOXES, CAMERA}),
    "files": (cloud_folder, ("",), ".bin clouds, no times in file names, 3 frames", set()),
}
each_recording = pytest.mark.parametrize("kind", MADE)
