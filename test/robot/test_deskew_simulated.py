"""Motion correction of simulated sweeps."""

from __future__ import annotations

import numpy as np

from lidar_perception.robot.deskew import deskew
from lidar_perception.robot.poses import interpolate_poses
from lidar_perception.simulation.raycast import cast_rays
from lidar_perception.simulation.returns import make_returns
from lidar_perception.simulation.sensor import Motion, make_generic_sensor
from lidar_perception.simulation.solids import BOX, CYLINDER, Solids
from lidar_perception.simulation.terrain import Ground

SENSOR = make_generic_sensor(24, -15.0, 10.0, 0.25, 10.0)
MOTION = Motion((15.0, 0.5, 0.0), 0.6, stamp=0.0)  # stamped at the start of the sweep


def make_objects(count=24):
    """Return which objects are poles, and poles and car-sized boxes around the sensor."""
    rng = np.random.default_rng(0)
    bearing, distance = np.arange(count) * 2 * np.pi / count, rng.uniform(6, 25, count)
    pole = np.arange(count) % 2 == 0
    half = np.where(pole[:, None], [0.1, 0.1, 2.0], [2.0, 0.9, 0.8])
    centre = np.column_stack([distance * np.cos(bearing), distance * np.sin(bearing), half[:, 2] - 1.73])
    return pole, Solids(
        np.where(pole, CYLINDER, BOX).astype(np.int8),
        centre,
        half,
        np.tile(np.eye(3), (count, 1, 1)),
        np.full(count, 0.5),
        np.full(count, 10, np.uint16),
        np.full(count, np.inf),
        np.zeros(count),
        np.arange(1, count + 1, dtype=np.int32),
        np.zeros((count, 3)),
    )


def test_deskewed_points_lie_on_the_measured_surfaces():
    """Odometry at 20 Hz, of a car at 15 m/s in a curve of 25 m radius."""
    pole, solids = make_objects()
    hits = cast_rays(solids, Ground(), np.array([0.0, 0.0, 1.73]), SENSOR, MOTION)
    true, reported = (
        make_returns(hits, SENSOR, MOTION, np.random.default_rng(0), compensated) for compensated in (True, False)
    )
    times = np.arange(-2, 4) * (10**9 // 20)
    seconds = times * 1e-9
    rotations = np.column_stack(
        [np.zeros((len(times), 2)), np.sin(seconds * MOTION.yaw_rate / 2), np.cos(seconds * MOTION.yaw_rate / 2)]
    )
    translations = seconds[:, None] * np.array(MOTION.velocity)
    corrected = deskew(
        reported.xyz,
        true.time.astype(float),
        lambda at: interpolate_poses(times, translations, rotations, np.rint(at * 1e9).astype(np.int64)),
    )
    np.testing.assert_allclose(corrected, true.xyz, atol=2e-3)
    seen = [i for i in range(1, len(pole) + 1) if (true.owner == i).sum() >= 5]
    assert {bool(pole[i - 1]) for i in seen} == {True, False} and len(seen) > 15
    error = [np.linalg.norm((reported.xyz - true.xyz)[true.owner == i].mean(axis=0)) for i in seen]
    assert np.median(error) > 0.5
