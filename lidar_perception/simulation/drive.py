"""Simulated drives: scans of a scene with full ground truth, one per revolution of the sensor."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lidar_perception.data.semantickitti import MOVING
from lidar_perception.simulation.raycast import Hits, cast_rays
from lidar_perception.simulation.returns import make_returns
from lidar_perception.simulation.scene import ALL_STREETS, Scene, Scenes, SceneState, make_scene
from lidar_perception.simulation.sensor import HDL64E, Sensor
from lidar_perception.simulation.trajectory import DRIVE_SECONDS
from lidar_perception.types import GroundTruth, InputError, PointCloud
from lidar_perception.wire.topics import LIDAR_FRAME

START_NS = 1_700_000_000 * 10**9
LABEL_RANGE_M = 80.0  # maximum distance of labelled objects, as in KITTI

MOVING_CLASSES = {static: moving for moving, static in MOVING.items()}


@dataclass(frozen=True)
class SimulatedScan:
    """One revolution of the sensor, with N points and ground truth.

    Attributes:
        frame: Cloud in the sensor's frame at frame.stamp_ns.
        truth: Labelled objects in all directions.
        semantic: (N,) uint16 SemanticKITTI classes, including those of moving objects.
        instance: (N,) uint16 track id of the object, 0 for none.
        ring: (N,) uint16, 0 is the highest beam.
        time: (N,) float32, seconds relative to the stamp.
        pose: (4, 4) float64 pose of the sensor, relative to its pose at the first scan of the drive.
    """

    frame: PointCloud
    truth: GroundTruth
    semantic: np.ndarray
    instance: np.ndarray
    ring: np.ndarray
    time: np.ndarray
    pose: np.ndarray


def count_drive_scans(sensor: Sensor) -> int:
    """Return the number of scans in a full drive."""
    return int(DRIVE_SECONDS * sensor.rate)


def simulate_drive(
    seed: int = 0, frames: int = 40, sensor: Sensor = HDL64E, scenes: Scenes = ALL_STREETS
) -> Iterator[SimulatedScan]:
    """Simulate a drive through make_scene(seed, *scenes). The same arguments give the same scans.

    Points and boxes are in the sensor's frame at the stamp, with motion correction. Objects without
    a point or beyond LABEL_RANGE_M are not labelled. The extras of labels are track_id, truncated
    (0.0), occluded (0, 1 or 2 as in KITTI), num_points, and visible (unoccluded fraction of the
    object).

    Raises:
        InputError: The seed or the number of frames is out of range. Raised before the first scan.
    """
    limit = count_drive_scans(sensor)
    if not 1 <= frames <= limit:
        raise InputError(f"frames = {frames} must be 1 .. {limit}, the number of scans in a drive")
    if seed < 0:
        raise InputError(f"seed = {seed} must not be negative")
    return (simulate_scan(seed, i, sensor, scenes) for i in range(frames))


def simulate_scan(seed: int, i: int, sensor: Sensor, scenes: Scenes = ALL_STREETS) -> SimulatedScan:
    """Simulate scan i of the drive through the scene of a seed; see simulate_drive."""
    # The seed shifts wandering beams too, because a scene may have only one scan.
    scene, sensor = _make_cached_scene(seed, scenes), sensor.shift_beams(seed + i)
    state = scene.compute_state(i / sensor.rate, sensor.height)
    hits = cast_rays(state.solids, scene.ground, state.position, sensor, state.motion, (seed << 20) + i, state.heading)
    returns = make_returns(hits, sensor, state.motion, np.random.default_rng([seed, i]))
    stamp = START_NS + round(i * 10**9 / sensor.rate)
    first_pose, pose = (scene.compute_sensor_pose(t, sensor.height) for t in (0.0, i / sensor.rate))
    pose[:3, 3] -= first_pose[:3, 3]
    pose[:3] = first_pose[:3, :3].T @ pose[:3]
    return SimulatedScan(
        PointCloud(returns.xyz, returns.intensity, stamp, LIDAR_FRAME),
        label_scan(state, hits, returns.owner),
        _mark_moving(state, returns.owner, returns.semantic),
        returns.owner.astype(np.uint16),
        returns.ring,
        returns.time,
        pose,
    )


def label_scan(state: SceneState, hits: Hits, owner: np.ndarray) -> GroundTruth:
    """Make the labels of a scan.

    Args:
        state: The scene at the time of the scan.
        hits: Hits of all rays.
        owner: (N,) track id of the object of each point, 0 for none.
    """
    size = len(hits.unoccluded_counts)
    point_counts = np.bincount(owner, minlength=size)[state.track_ids]
    hit_counts = np.bincount(hits.owner.ravel(), minlength=size)[state.track_ids]
    # Limited to 1, because the edge of a beam may hit an object that no beam centre hits.
    visible = np.minimum(hit_counts / np.maximum(hits.unoccluded_counts[state.track_ids], 1), 1.0)
    occluded = (visible < 0.8).astype(int) + (visible < 0.4)
    is_labelled = (point_counts > 0) & (np.hypot(*state.boxes[:, :2].T) <= LABEL_RANGE_M)
    extras = [
        {
            "track_id": int(state.track_ids[k]),
            "truncated": 0.0,
            "occluded": int(occluded[k]),
            "num_points": int(point_counts[k]),
            "visible": float(visible[k]),
        }
        for k in np.flatnonzero(is_labelled)
    ]
    return GroundTruth.of(state.boxes[is_labelled], state.class_ids[is_labelled], extras)


@functools.lru_cache(maxsize=2)
def _make_cached_scene(seed: int, scenes: Scenes) -> Scene:
    return make_scene(seed, *scenes)


def _mark_moving(state: SceneState, owner: np.ndarray, semantic: np.ndarray) -> np.ndarray:
    """Return the classes (N,) with SemanticKITTI's moving classes for points on moving objects."""
    is_moving = np.zeros(int(max(state.track_ids, default=0)) + 1, bool)
    is_moving[state.track_ids[state.speeds > 0]] = True
    moving_class = np.arange(1 << 16, dtype=np.uint16)
    moving_class[list(MOVING_CLASSES)] = list(MOVING_CLASSES.values())
    return np.where(is_moving[owner], moving_class[semantic], semantic)
