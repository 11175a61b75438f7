"""Simulated scans as tensors, without files."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import torch

from lidar_perception.simulation.drive import simulate_scan
from lidar_perception.simulation.scene import ALL_STREETS, Scenes
from lidar_perception.simulation.sensor import HDL64E, Sensor


def generate_training_scans(seed: int = 0, sensor: Sensor = HDL64E,
                            scenes: Scenes = ALL_STREETS) -> Iterator[dict[str, torch.Tensor]]:
    """Yield the first scan of the scenes seed, seed + 1, ..., with all labels, without end.

    In worker w of n of a DataLoader it yields every nth scene from seed + w on, so that the workers
    together yield each scene once.

    Yields:
        points (N, 4) float32 [x y z intensity], boxes (K, 7) float32 and class_ids (K,) int64 as in
        GroundTruth, and num_points (K,) int64.
    """
    worker = torch.utils.data.get_worker_info()
    first, step = (worker.id, worker.num_workers) if worker else (0, 1)
    for number in itertools.count(seed + first, step):
        scan = simulate_scan(number, 0, sensor, scenes)
        arrays = {
            "points": scan.frame.points(),
            "boxes": scan.truth.boxes.astype(np.float32),
            "class_ids": scan.truth.class_ids.astype(np.int64),
            "num_points": np.array([e["num_points"] for e in scan.truth.extras], np.int64)}
        yield {name: torch.from_numpy(array) for name, array in arrays.items()}
