"""Simulated data sets in the layouts of KITTI and SemanticKITTI, written by several processes.

A frame depends only on its number, so the number of processes and interruptions do not change the files.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from lidar_perception.data import semantickitti
from lidar_perception.data.kitti import write as write_kitti
from lidar_perception.runs.processes import run_in_processes
from lidar_perception.runs.resumable_folder import finish_frame
from lidar_perception.simulation.camera import FORWARD_CAMERA, make_kitti_labels
from lidar_perception.simulation.drive import count_drive_scans, simulate_scan
from lidar_perception.simulation.scene import ALL_STREETS, Scenes
from lidar_perception.simulation.sensor import Sensor
from lidar_perception.types import InputError

LAYOUTS = ("kitti", "kitti-tracking", "semantickitti")
FOLDERS = ("training", "sequences")  # top-level folders of these layouts


@dataclass(frozen=True)
class DatasetPlan:
    """Content of a simulated data set.

    Attributes:
        layout: One of LAYOUTS.
        sensor: The sensor.
        seed: Seed of the first scene; the next scene has seed + 1.
        frames: Number of scans.
        frames_per_drive: Number of scans of each scene.
        scenes: Types of the scenes.

    Raises:
        InputError: frames_per_drive or scenes is invalid.
    """

    layout: str
    sensor: Sensor
    seed: int
    frames: int
    frames_per_drive: int
    scenes: Scenes = ALL_STREETS

    def __post_init__(self) -> None:
        self.scenes.scene_types()
        limit = count_drive_scans(self.sensor)
        if not 1 <= self.frames_per_drive <= limit:
            raise InputError(
                f"streets-of = {self.frames_per_drive} must be 1 .. {limit}, the number of scans in a drive"
            )


def write_frame(folder: Path, plan: DatasetPlan, number: int) -> int:
    """Simulate a frame, write its files, and return its number. Raise InputError if a file cannot be written."""
    sequence, scan_index = divmod(number, plan.frames_per_drive)
    scan = simulate_scan(plan.seed + sequence, scan_index, plan.sensor, plan.scenes)
    order = np.argsort(scan.ring, kind="stable")  # beam by beam, as in KITTI's files
    cloud = scan.frame.points()[order]
    shared_files = {}  # text that this frame adds to the files of its drive, by path
    if plan.layout == "kitti":
        write_kitti.write_object(folder, number, cloud, make_kitti_labels(scan.truth), FORWARD_CAMERA)
    elif plan.layout == "kitti-tracking":
        name = f"{sequence:04}"
        write_kitti.write_velodyne(folder / f"training/velodyne/{name}/{scan_index:06}.bin", cloud)
        labels = write_kitti.format_tracking_labels(scan_index, make_kitti_labels(scan.truth), FORWARD_CAMERA)
        shared_files[f"training/label_02/{name}.txt"] = labels
        if scan_index == 0:
            shared_files[f"training/calib/{name}.txt"] = write_kitti.format_calibration(FORWARD_CAMERA)
    else:
        digits = max(2, len(str((plan.frames - 1) // plan.frames_per_drive)))
        name = f"sequences/{sequence:0{digits}}"
        semantickitti.write_scan(folder / name, scan_index, cloud, scan.semantic[order], scan.instance[order])
        shared_files[f"{name}/poses.txt"] = semantickitti.format_pose(scan.pose, FORWARD_CAMERA)
        shared_files[f"{name}/times.txt"] = f"{scan_index / plan.sensor.rate:.6e}\n"
        if scan_index == 0:
            shared_files[f"{name}/calib.txt"] = semantickitti.format_calibration(FORWARD_CAMERA)
    finish_frame(folder, number, shared_files)
    return number


def write_frames(folder: Path, plan: DatasetPlan, numbers: list[int], jobs: int) -> Generator[int]:
    """Write frames in several processes, which end with the iterator, and yield the number of each written frame."""
    return run_in_processes(partial(partial, write_frame, folder, plan), numbers, jobs, "wrote frames")
