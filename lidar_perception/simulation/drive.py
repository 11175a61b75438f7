"""Simulated drives: scans of a scene with full ground truth, one per turn of the sensor."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lidar_perception.data.semantickitti import MOVING
from lidar_perception.simulation.raycast import Hits, cast_rays
from lidar_perception.simulation.returns import make_returns
from lidar_perception.simulation.scene import ALL_STREETS, Scene, SceneMoment, Scenes, make_scene
from lidar_perception.simulation.sensor import HDL64E, Sensor
from lidar_perception.simulation.trajectory import DRIVE_SECONDS
from lidar_perception.types import GroundTruth, InputError, PointCloud
from lidar_perception.wire.topics import LIDAR_FRAME

START_NS = 1_700_000_000 * 10**9
LABEL_RANGE_M = 80.0  # farther objects have no label, as in KITTI

MOVING_CLASSES = {static: moving for moving, static in MOVING.items()}


@dataclass(frozen=True)
class SimulatedScan:
    """One turn of the sensor, with N points and ground truth.

    Attributes:
        frame: Cloud in the sensor's frame at frame.stamp_ns.
        truth: Labelled objects in all directions.
        semantic: (N,) uint16 SemanticKITTI classes, including the moving ones.
        instance: (N,) uint16 track id of the object, 0 for none.
        ring: (N,) uint16, 0 is the highest beam.
        time: (N,) float32, seconds after the stamp.
        pose: (4, 4) float64 pose of the sensor, relative to its pose at the first scan of the drive.
    """

    frame: PointCloud
    truth: GroundTruth
    semantic: np.ndarray
    instance: np.ndarray
    ring: np.ndarray
    time: np.ndarray
    pose: np.ndarray


def longest_drive(sensor: Sensor) -> int:
    """Return the number of scans in a full drive."""
    return int(DRIVE_SECONDS * sensor.rate)


def choose_drive_frame(moment: int, moments: int, sensor: Sensor) -> int:
    """Return the scan number of one of several moments that are spread evenly over a drive."""
    return moment * longest_drive(sensor) // moments


def simulate_drive(
    seed: int = 0, frames: int = 40, sensor: Sensor = HDL64E, scenes: Scenes = ALL_STREETS
) -> Iterator[SimulatedScan]:
    """Simulate a drive through make_scene(seed, *scenes), deterministically.

    Points and boxes are in the sensor's frame at the stamp, with motion correction. Objects without
    a point or beyond LABEL_RANGE_M have no label. The extras of labels are track_id, truncated
    (0.0), occluded (0 | 1 | 2 as in KITTI), num_points, and visible (share of the object that is
    not hidden).

    Raises:
        InputError: The seed or the number of frames is out of range; raised at the call.
    """
    limit = longest_drive(sensor)
    if not 1 <= frames <= limit:
        raise InputError(f"frames = {frames} must be 1 .. {limit}, the length of the drive")
    if seed < 0:
        raise InputError(f"seed = {seed} must not be negative")
    return (simulate_scan(seed, i, sensor, scenes) for i in range(frames))


def simulate_scan(seed: int, i: int, sensor: Sensor, scenes: Scenes = ALL_STREETS) -> SimulatedScan:
    """Simulate scan i of the drive through the scene of a seed, independently of other scans."""
    # Wandering beams differ between scenes too, since a scene may have only one scan.
    scene, sensor = _make_cached_scene(seed, scenes), sensor.at_turn(seed + i)
    moment = scene.at(i / sensor.rate, sensor.height)
    hits = cast_rays(
        moment.solids, scene.ground, moment.position, sensor, moment.motion, (seed << 20) + i, moment.heading
    )
    returns = make_returns(hits, sensor, moment.motion, np.random.default_rng([seed, i]))
    stamp = START_NS + round(i * 10**9 / sensor.rate)
    first, pose = (scene.sensor_pose(t, sensor.height) for t in (0.0, i / sensor.rate))
    pose[:3, 3] -= first[:3, 3]
    pose[:3] = first[:3, :3].T @ pose[:3]
    return SimulatedScan(
        PointCloud(returns.xyz, returns.intensity, stamp, LIDAR_FRAME),
        label_scan(moment, hits, returns.owner),
        _mark_moving(moment, returns.owner, returns.semantic),
        returns.owner.astype(np.uint16),
        returns.ring,
        returns.time,
        pose,
    )


def label_scan(moment: SceneMoment, hits: Hits, owner: np.ndarray) -> GroundTruth:
    """Make the labels of a scan; owner: (N,) track id of each point, 0 for none."""
    size = len(hits.reached)
    points = np.bincount(owner, minlength=size)[moment.track_ids]
    visible = np.bincount(hits.owner.ravel(), minlength=size)[moment.track_ids]
    # At most 1, since the edge of a beam may hit an object that no beam centre hits.
    share = np.minimum(visible / np.maximum(hits.reached[moment.track_ids], 1), 1.0)
    occluded = (share < 0.8).astype(int) + (share < 0.4)
    keep = (points > 0) & (np.hypot(*moment.boxes[:, :2].T) <= LABEL_RANGE_M)
    extras = [
        {"track_id": int(track), "truncated": 0.0, "occluded": int(level), "num_points": int(n), "visible": float(part)}
        for track, level, n, part in zip(moment.track_ids[keep], occluded[keep], points[keep], share[keep])
    ]
    return GroundTruth.of(moment.boxes[keep], moment.class_ids[keep], extras)


@functools.lru_cache(maxsize=2)
def _make_cached_scene(seed: int, scenes: Scenes) -> Scene:
    return make_scene(seed, *scenes)


def _mark_moving(moment: SceneMoment, owner: np.ndarray, semantic: np.ndarray) -> np.ndarray:
    """Replace the classes (N,) of points on moving objects by SemanticKITTI's moving classes."""
    moves = np.zeros(int(max(moment.track_ids, default=0)) + 1, bool)
    moves[moment.track_ids[moment.speeds > 0]] = True
    table = np.arange(1 << 16, dtype=np.uint16)
    table[list(MOVING_CLASSES)] = list(MOVING_CLASSES.values())
    return np.where(moves[owner], table[semantic], semantic)
