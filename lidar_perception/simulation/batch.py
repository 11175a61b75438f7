"""Simulated scans as tensors, without files."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import torch

from lidar_perception.simulation.drive import choose_drive_frame, longest_drive, simulate_scan
from lidar_perception.simulation.scene import ALL_STREETS, Scenes
from lidar_perception.simulation.sensor import HDL64E, Sensor
from lidar_perception.types import InputError


def generate_training_scans(seed: int = 0, sensor: Sensor = HDL64E, scenes: Scenes = ALL_STREETS,
                            moments: int = 1) -> Iterator[dict[str, torch.Tensor]]:
    """Yield scans of the scenes seed, seed + 1, ... without end, with all their labels.

    In worker w of n of a DataLoader: every nth scene from seed + w on, so that the workers together
    give each scene once.

    Args:
        moments: Scans of each scene, spread evenly over its drive. Making a scene takes about as
            long as scanning it once, so 4 moments of one scene take half the time of 4 scenes.

    Returns:
        points (N, 4) float32 [x y z intensity], boxes (K, 7) float32 and class_ids (K,) int64 as in
        GroundTruth, num_points (K,) int64.

    Raises:
        InputError: (at the call) moments is less than 1 or more than the scans of a drive.
    """
    if not 1 <= moments <= longest_drive(sensor):
        raise InputError(f"moments = {moments} must be 1 .. {longest_drive(sensor)}, the scans of "
                         "a drive")
    return _training_scans(seed, sensor, scenes, moments)


def _training_scans(seed: int, sensor: Sensor, scenes: Scenes,
                    moments: int) -> Iterator[dict[str, torch.Tensor]]:
    worker = torch.utils.data.get_worker_info()
    first, step = (worker.id, worker.num_workers) if worker else (0, 1)
    scans = ((number, moment) for number in itertools.count(seed + first, step)
             for moment in range(moments))  # itertools.product would never start
    for number, moment in scans:
        scan = simulate_scan(number, choose_drive_frame(moment, moments, sensor), sensor, scenes)
        arrays = {
            "points": scan.frame.points(),
            "boxes": scan.truth.boxes.astype(np.float32),
            "class_ids": scan.truth.class_ids.astype(np.int64),
            "num_points": np.array([e["num_points"] for e in scan.truth.extras], np.int64)}
        yield {name: torch.from_numpy(array) for name, array in arrays.items()}
