"""Cost of KISS-ICP compared with a detector, and the error of its poses.

    python -m benchmark.odometry --data /data/kitti/tracking
    python -m benchmark.odometry --streets 6

Each scan is processed in turn by KISS-ICP with default settings, by Odometry, and by the detectors.
CPU time is measured, which hardly changes on a busy machine. Simulated streets have exact poses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from time import process_time

import click
import numpy as np
import torch
from kiss_icp.config.parser import KISSConfig
from kiss_icp.kiss_icp import KissICP
from rich.table import Table

from lidar_perception.data.open import open_recording
from lidar_perception.detectors.open import open_detector
from lidar_perception.robot.poses import invert_pose
from lidar_perception.runs.terminal import console, show_progress
from lidar_perception.simulation.drive import simulate_drive
from lidar_perception.tracking.ego import Odometry
from lidar_perception.types import PointCloud

DETECTORS = ("fused", "pointnet")
FIRST_STREET, FURTHER = 7301, 10  # frames over which drift is said
Scans = Iterator[tuple[str, PointCloud, np.ndarray | None]]


def make_default_odometry() -> Callable[[np.ndarray], np.ndarray]:
    """Return KISS-ICP with its default settings and the voxel size of Odometry."""
    config = KISSConfig()
    config.mapping.voxel_size, config.data.deskew = 1.0, False
    icp = KissICP(config)

    def pose(xyz: np.ndarray) -> np.ndarray:
        icp.register_frame(np.asarray(xyz, np.float64), np.zeros(0))
        return np.array(icp.last_pose)
    return pose


def read_scans(data: Path, frames: int) -> Scans:
    """Return the first scans of a recording."""
    for frame in islice(open_recording(data), frames):
        yield frame.sequence, frame.load(), None


def simulate_scans(streets: int, frames: int) -> Scans:
    """Return the first scans of several streets."""
    for street in range(FIRST_STREET, FIRST_STREET + streets):
        for scan in simulate_drive(street, frames):
            yield str(street), scan.frame, scan.pose


def measure_odometry(given: Scans, detectors: tuple[str, ...]) -> dict[str, dict[str, float]]:
    """Measure odometry and detectors by name.

    ms is the median CPU time per scan. Where poses are known, step and drift are root mean square
    errors in metres over the next frame and over FURTHER frames.
    """
    torch.set_num_threads(1)
    found = {name: open_detector(name, "cpu") for name in detectors}
    sources = {"KISS-ICP as it comes": make_default_odometry, "Odometry": Odometry}
    ms: dict[str, list[float]] = {name: [] for name in (*sources, *found)}
    ways: dict[str, list[tuple[np.ndarray, ...]]] = {}
    for drive, frame, pose in given:
        if drive not in ways:
            ways[drive], taken = [], {name: make() for name, make in sources.items()}
        poses = []
        for name in ms:
            start = process_time()
            if name in sources:
                poses.append(taken[name](frame.xyz))
            else:
                found[name](frame)
            ms[name].append(1e3 * (process_time() - start))
        if pose is not None:
            ways[drive].append((pose, *poses))
    result = {name: {"ms": float(np.median(values))} for name, values in ms.items()}
    known = [np.array(way) for way in ways.values() if len(way) > FURTHER]  # (frames, 1 + 2, 4, 4)
    for i, name in enumerate(sources, 1):
        for what, step in ("step", 1), ("drift", FURTHER):
            if known:
                off = np.concatenate([_compute_error(way[:, i], way[:, 0], step) for way in known])
                result[name][what] = float(np.sqrt(np.mean(off ** 2)))
    return result


def _compute_error(poses: np.ndarray, true: np.ndarray, step: int) -> np.ndarray:
    """Return the BEV distance (frames - step,) in metres between two motions over `step` frames."""
    there, meant = (invert_pose(p[:-step]) @ p[step:] for p in (poses, true))
    return np.linalg.norm((invert_pose(meant) @ there)[:, :2, 3], axis=1)


@click.command()
@click.option("--data", type=click.Path(exists=True, path_type=Path), help="A recording.")
@click.option("--streets", type=click.IntRange(1), default=6, show_default=True,
              help="Simulated ones, where there is no --data.")
@click.option("--frames", type=click.IntRange(2), default=30, show_default=True)
def main(data: Path | None, streets: int, frames: int) -> None:
    """Measure the cost of KISS-ICP compared with a detector, and the error of its poses."""
    given = read_scans(data, frames) if data else simulate_scans(streets, frames)
    content = measure_odometry(show_progress(given, "driving", frames * (1 if data else streets)),
                               DETECTORS if data else ())
    table = Table(title="A scan: CPU ms; metres off over 1 frame, over 10")
    for name in ("", "CPU ms", "1", "10"):
        table.add_column(name, justify="right" if name else "left")
    for name, row in content.items():
        table.add_row(name, f"{row['ms']:.1f}", *(f"{row[key]:.3f}" if key in row else "-"
                                                  for key in ("step", "drift")))
    console.print(table)


if __name__ == "__main__":
    main(prog_name="python -m benchmark.odometry")
