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
from lidar_perception.simulation.drive import SimulatedScan, count_drive_scans, simulate_scan
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
    """Simulate a frame, write its files, and return its number.

    Raises:
        InputError: A file cannot be written.
    """
    sequence, scan_index = divmod(number, plan.frames_per_drive)
    scan = simulate_scan(plan.seed + sequence, scan_index, plan.sensor, plan.scenes)
    order = np.argsort(scan.ring, kind="stable")  # beam by beam, as in KITTI's files
    cloud = scan.frame.points()[order]
    if plan.layout == "semantickitti":
        shared_files = _write_semantickitti(folder, plan, sequence, scan_index, scan, cloud, order)
    else:
        truth = make_kitti_labels(scan.truth)
        if plan.layout == "kitti":
            write_kitti.write_object(folder, number, cloud, truth, FORWARD_CAMERA)
            shared_files = {}
        else:
            name = f"{sequence:04}"
            write_kitti.write_velodyne(folder / f"training/velodyne/{name}/{scan_index:06}.bin", cloud)
            shared_files = {
                f"training/label_02/{name}.txt": write_kitti.format_tracking_labels(scan_index, truth, FORWARD_CAMERA)
            }
            if scan_index == 0:
                calibration = write_kitti.format_calibration(FORWARD_CAMERA)
                shared_files[f"training/calib/{name}.txt"] = calibration
    finish_frame(folder, number, shared_files)
    return number


def _write_semantickitti(
    folder: Path,
    plan: DatasetPlan,
    sequence: int,
    scan_index: int,
    scan: SimulatedScan,
    cloud: np.ndarray,
    order: np.ndarray,
) -> dict[str, str]:
    digits = max(2, len(str((plan.frames - 1) // plan.frames_per_drive)))
    name = f"sequences/{sequence:0{digits}}"
    semantickitti.write_scan(folder / name, scan_index, cloud, scan.semantic[order], scan.instance[order])
    shared_files = {
        f"{name}/poses.txt": semantickitti.format_pose(scan.pose, FORWARD_CAMERA),
        f"{name}/times.txt": f"{scan_index / plan.sensor.rate:.6e}\n",
    }
    if scan_index == 0:
        shared_files[f"{name}/calib.txt"] = semantickitti.format_calibration(FORWARD_CAMERA)
    return shared_files


def write_frames(folder: Path, plan: DatasetPlan, numbers: list[int], jobs: int) -> Generator[int]:
    """Write frames in several processes, and yield the number of each written frame.

    The processes end when the iterator is closed.

    Raises:
        InputError: A process failed.
    """
    return run_in_processes(partial(partial, write_frame, folder, plan), numbers, jobs, "wrote frames")
