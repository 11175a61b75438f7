"""Gain of motion correction on simulated scans of a moving sensor.

    python -m benchmark.motion [STREETS]

Clouds are compared as the sensor reports them and as corrected by odometry. The error of an object
is the distance from the mean of its points to the mean of the same points in the sensor's frame at
the stamp. The odometry is exact and has 50 Hz.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Iterator
from functools import partial

import numpy as np
from rich.table import Table

from lidar_perception.detectors.contract import Detector
from lidar_perception.detectors.open import open_detector
from lidar_perception.robot.deskew import deskew
from lidar_perception.robot.poses import interpolate_poses
from lidar_perception.runs.terminal import console
from lidar_perception.simulation.drive import label_scan
from lidar_perception.simulation.raycast import cast_rays
from lidar_perception.simulation.returns import make_returns
from lidar_perception.simulation.scene import make_scene
from lidar_perception.simulation.sensor import HDL64E, Motion, make_rays
from lidar_perception.types import CLASSES, PointCloud

YAW_RATES = 0.0, 0.3, 0.6  # rad/s; at 10 m/s the last is a turn of 17 m
POLE = 80                  # SemanticKITTI
FEW = 10                   # points; things with fewer are left out
NEAR = 2.0                 # m between a detection and its label
ODOMETRY_HZ = 50


def make_odometry(motion: Motion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times (K,) ns around the stamp, translations (K, 3) and quaternions (K, 4)."""
    step = 10**9 // ODOMETRY_HZ
    times = np.arange(-6, 7) * step + step // 3
    half = times * 1e-9 * motion.yaw_rate / 2
    return (times, times[:, None] * 1e-9 * np.asarray(motion.velocity),
            np.column_stack([np.zeros((len(times), 2)), np.sin(half), np.cos(half)]))


def read_poses(way: tuple[np.ndarray, np.ndarray, np.ndarray], at: np.ndarray) -> np.ndarray:
    """Return the poses (N, 4, 4) of an odometry at times (N,), seconds."""
    return interpolate_poses(*way, np.rint(at * 1e9).astype(np.int64))


def simulate_turns(seed: int) -> Iterator[tuple]:
    """Simulate turns of the sensor in a street.

    Returns speed, yaw rate, the true, reported and corrected clouds with the same points, the
    object of each point (0: none), which objects are static boxes, and the labels.
    """
    scene = make_scene(seed)
    moment = scene.at(5.0, HDL64E.height)
    for motion in (moment.motion._replace(yaw_rate=rate) for rate in YAW_RATES):
        hits = cast_rays(moment.solids, scene.ground, moment.position, HDL64E, motion, seed)
        met, reported = (
            make_returns(hits, HDL64E, motion, np.random.default_rng(seed), compensated)
            for compensated in (True, False))
        corrected = deskew(
            reported.xyz, met.time.astype(float), partial(read_poses, make_odometry(motion))
        )
        since = make_rays(HDL64E, motion).since.astype(np.float32)
        order = np.argsort(since)
        solid = hits.solid[order[np.searchsorted(since[order], met.time)], met.ring]
        boxes = 1 + int(moment.track_ids.max(initial=0))
        thing = np.where((met.semantic == POLE) & (solid >= 0), boxes + solid, met.owner)
        standing = np.zeros(boxes, bool)
        standing[moment.track_ids[moment.speeds == 0]] = True
        yield (float(np.linalg.norm(motion.velocity)), motion.yaw_rate, (met, reported, corrected),
               thing, standing, label_scan(moment, hits, met.owner))


def compute_errors(xyz: np.ndarray, met: np.ndarray, thing: np.ndarray) -> dict[int, float]:
    """Return the distance in metres between the means of the points of each object."""
    count = np.bincount(thing)
    shift = np.column_stack([np.bincount(thing, axis) for axis in (xyz - met).astype(float).T])
    return {i: float(np.linalg.norm(shift[i] / count[i]))
            for i in np.flatnonzero(count >= FEW).tolist() if i}


def measure_detections(
    detector: Detector, xyz: np.ndarray, intensity: np.ndarray, labels
) -> list[float]:
    """Measure the detection errors of a cloud.

    Returns the BEV distance in metres between each detected label and the nearest detection of its
    class.
    """
    found, far = detector(PointCloud(xyz, intensity)).detections, []
    for box, kind in zip(labels.boxes, labels.class_ids):
        same = found.boxes[found.class_ids == kind]
        apart = np.hypot(*(same[:, :2] - box[:2]).T).min(initial=np.inf)
        if apart < NEAR and CLASSES[kind] in detector.classes:
            far.append(float(apart))
    return far


def measure(streets: int) -> None:
    """Print the table."""
    detector = open_detector("pointpillars")
    rows: dict[tuple, list[float]] = defaultdict(list)
    speeds = []
    for seed in range(streets):
        for speed, rate, (met, reported, corrected), thing, standing, labels in simulate_turns(
            seed
        ):
            speeds.append(speed)
            for name, xyz in (("reported", reported.xyz), ("corrected", corrected)):
                for i, error in compute_errors(xyz, met.xyz, thing).items():
                    kind = "poles" if i >= len(standing) else "standing boxes"
                    if i >= len(standing) or standing[i]:
                        rows[rate, kind, name].append(error)
            for name, xyz in (("met", met.xyz), ("reported", reported.xyz),
                              ("corrected", corrected)):
                rows[rate, "detections", name] += measure_detections(
                    detector, xyz, met.intensity, labels
                )
    table = Table(title=f"{streets} streets, {np.mean(speeds):.1f} m/s in the mean")
    for column in ("yaw rate, rad/s", "of", "number", "median, m", "95 %, m"):
        table.add_column(column)
    for (rate, kind, name), values in sorted(rows.items()):
        table.add_row(f"{rate:g}", f"{kind}, {name}", str(len(values)),
                      f"{np.median(values):.3f}", f"{np.quantile(values, 0.95):.3f}")
    console.print(table)


if __name__ == "__main__":
    measure(int(sys.argv[1]) if len(sys.argv) > 1 else 20)
