"""A simulated drive: labelled scans, one a turn of the sensor."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lidar_perception.simulation.raycast import Hits, cast, measure
from lidar_perception.simulation.scene import SECONDS, Moment, make_scene
from lidar_perception.simulation.sensor import HDL64E, Sensor
from lidar_perception.topics import LIDAR_FRAME
from lidar_perception.types import GroundTruth, InputError, LidarFrame

START_NS = 1_700_000_000 * 10**9
LABEL_RANGE = 80.0  # metres; what is farther has no label, as in KITTI


def drive(seed: int = 0, frames: int = 40,
          sensor: Sensor = HDL64E) -> Iterator[tuple[LidarFrame, GroundTruth]]:
    """Scans of the street make_scene(seed), with their truth; the same for the same arguments.

    Each scan is a snapshot: the sensor does not move during a turn. Objects without a point or
    beyond LABEL_RANGE have no label. extras: track_id, truncated 0.0, occluded 0 | 1 | 2 as in
    KITTI, num_points. ValueError (at the call) for a seed or a number of frames out of range.
    """
    most = int(SECONDS * sensor.rate)
    if not 1 <= frames <= most:
        raise InputError(f"frames = {frames} must be 1 .. {most}: the street is that long")
    if seed < 0:
        raise InputError(f"seed = {seed} must not be negative")
    return (_scan(seed, i, sensor, scene) for scene in [make_scene(seed)] for i in range(frames))


def _scan(seed, i, sensor, scene) -> tuple[LidarFrame, GroundTruth]:
    moment = scene.at(i / sensor.rate, sensor.height)
    hits = cast(moment.solids, scene.ground, moment.position, sensor)
    xyz, intensity, owner = measure(hits, sensor, np.random.default_rng([seed, i]))
    stamp = START_NS + round(i * 10**9 / sensor.rate)
    return LidarFrame(xyz, intensity, stamp, LIDAR_FRAME), truth(moment, hits, owner)


def truth(moment: Moment, hits: Hits, owner: np.ndarray) -> GroundTruth:
    """The labels of a scan whose points belong to owner (N,)."""
    size = len(hits.reached)
    points = np.bincount(owner, minlength=size)[moment.track_ids]
    visible = np.bincount(hits.owner.ravel(), minlength=size)[moment.track_ids]
    share = visible / np.maximum(hits.reached[moment.track_ids], 1)
    occluded = (share < 0.8).astype(int) + (share < 0.4)
    keep = (points > 0) & (np.hypot(*moment.boxes[:, :2].T) <= LABEL_RANGE)
    extras = [{"track_id": int(track), "truncated": 0.0, "occluded": int(level),
               "num_points": int(n)}
              for track, level, n in zip(moment.track_ids[keep], occluded[keep], points[keep])]
    return GroundTruth.of(moment.boxes[keep], moment.class_ids[keep], extras)
