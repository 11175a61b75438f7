"""Simulated drives: scans of a scene, one a turn of the sensor, with all that is known of them."""

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
LABEL_RANGE_M = 80.0  # metres; what is farther has no label, as in KITTI

MOVING_CLASSES = {still: moving for moving, still in MOVING.items()}


@dataclass(frozen=True)
class SimulatedScan:
    """One turn of the sensor: N points, in the sensor's frame at frame.stamp_ns.

    truth: the objects all around; semantic (N,) uint16 SemanticKITTI classes, the moving ones
    too; instance (N,) uint16 track id of the object, 0 for none; ring (N,) uint16, 0 the highest
    beam; time (N,) float32 seconds after the stamp; pose (4, 4) float64 the sensor's frame in that
    of the drive's first scan.
    """

    frame: PointCloud
    truth: GroundTruth
    semantic: np.ndarray
    instance: np.ndarray
    ring: np.ndarray
    time: np.ndarray
    pose: np.ndarray


def longest_drive(sensor: Sensor) -> int:
    """Scans that fit into the time of one drive."""
    return int(DRIVE_SECONDS * sensor.rate)


def simulate_drive(seed: int = 0, frames: int = 40, sensor: Sensor = HDL64E,
                   scenes: Scenes = ALL_STREETS) -> Iterator[SimulatedScan]:
    """A drive through make_scene(seed, *scenes); the same for the same arguments.

    Points are where they were met, in the sensor's frame at the stamp; boxes are those at the
    stamp. Objects without a point or beyond LABEL_RANGE have no label. extras: track_id,
    truncated 0.0, occluded 0 | 1 | 2 as in KITTI, num_points, visible (the share of the object's
    directions that is not hidden behind others). InputError (at the call) for a seed
    or a number of frames out of range.
    """
    most = longest_drive(sensor)
    if not 1 <= frames <= most:
        raise InputError(f"frames = {frames} must be 1 .. {most}: the street is that long")
    if seed < 0:
        raise InputError(f"seed = {seed} must not be negative")
    return (simulate_scan(seed, i, sensor, scenes) for i in range(frames))


def simulate_scan(seed: int, i: int, sensor: Sensor, scenes: Scenes = ALL_STREETS) -> SimulatedScan:
    """Scan i of the drive through the scene of a seed, whatever was asked for before."""
    # Beams that wander do so from scene to scene too: of each there may be one scan only.
    scene, sensor = _make_cached_scene(seed, scenes), sensor.at_turn(seed + i)
    moment = scene.at(i / sensor.rate, sensor.height)
    hits = cast_rays(moment.solids, scene.ground, moment.position, sensor, moment.motion,
                     (seed << 20) + i, moment.heading)
    got = make_returns(hits, sensor, moment.motion, np.random.default_rng([seed, i]))
    stamp = START_NS + round(i * 10**9 / sensor.rate)
    first, pose = (scene.sensor_pose(t, sensor.height) for t in (0.0, i / sensor.rate))
    pose[:3, 3] -= first[:3, 3]
    pose[:3] = first[:3, :3].T @ pose[:3]
    return SimulatedScan(
        PointCloud(got.xyz, got.intensity, stamp, LIDAR_FRAME), label_scan(moment, hits, got.owner),
        _mark_moving(moment, got.owner, got.semantic), got.owner.astype(np.uint16), got.ring,
        got.time, pose)


def label_scan(moment: SceneMoment, hits: Hits, owner: np.ndarray) -> GroundTruth:
    """The labels of a scan whose points belong to owner (N,)."""
    size = len(hits.reached)
    points = np.bincount(owner, minlength=size)[moment.track_ids]
    visible = np.bincount(hits.owner.ravel(), minlength=size)[moment.track_ids]
    # The rim of a beam may meet an object that the middle of none would.
    share = np.minimum(visible / np.maximum(hits.reached[moment.track_ids], 1), 1.0)
    occluded = (share < 0.8).astype(int) + (share < 0.4)
    keep = (points > 0) & (np.hypot(*moment.boxes[:, :2].T) <= LABEL_RANGE_M)
    extras = [{"track_id": int(track), "truncated": 0.0, "occluded": int(level),
               "num_points": int(n), "visible": float(part)}
              for track, level, n, part in zip(moment.track_ids[keep], occluded[keep],
                                               points[keep], share[keep])]
    return GroundTruth.of(moment.boxes[keep], moment.class_ids[keep], extras)


@functools.lru_cache(maxsize=2)
def _make_cached_scene(seed: int, scenes: Scenes) -> Scene:
    return make_scene(seed, *scenes)


def _mark_moving(moment: SceneMoment, owner: np.ndarray, semantic: np.ndarray) -> np.ndarray:
    """semantic (N,) with the classes of what moves for the points of owners that do."""
    moves = np.zeros(int(max(moment.track_ids, default=0)) + 1, bool)
    moves[moment.track_ids[moment.speeds > 0]] = True
    table = np.arange(1 << 16, dtype=np.uint16)
    table[list(MOVING_CLASSES)] = list(MOVING_CLASSES.values())
    return np.where(moves[owner], table[semantic], semantic)
