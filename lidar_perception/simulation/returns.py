"""Returns of a sensor for the hits of its rays: noise, losses and intensity."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidar_perception.simulation.raycast import Hits
from lidar_perception.simulation.sensor import NO_MOTION, Motion, Sensor, make_rays
from lidar_perception.simulation.solids import RETROREFLECTOR

# The power of a return is proportional to cos(incidence) ** GRAZING_EXPONENT, and its logarithm has a
# random error. With these values, returns from the road are lost at the same ranges as in front of
# KITTI's car: 0.7 of the rays return at 38 m, 0.5 at 43 m, 0.35 at 50 m, and none at 60 m (median of 27
# scans). Neighbouring returns are lost together: in SemanticKITTI, only 0.03 of the returns from the
# road beyond 35 m are lost singly.
GRAZING_EXPONENT = 1 / 3
POWER_SCATTER = 0.5  # standard deviation of the log power
SCATTER_COLUMNS = 16  # number of adjacent columns with the same error of the log power
INTENSITY_NOISE = 0.035  # SemanticKITTI has 0.03 on roads and sidewalks, and 0.04 on facades


class Returns(NamedTuple):
    """N points of one revolution, in the order of KITTI's files: by beam, then counter-clockwise from x.

    Attributes:
        xyz: (N, 3) float32, m in the sensor's frame.
        intensity: (N,) float32, 0..1 in hundredths.
        owner: (N,) int32, see Hits.
        semantic: (N,) uint16, see Hits.
        ring: (N,) uint16, 0 is the highest beam.
        time: (N,) float32, seconds relative to the stamp.
    """

    xyz: np.ndarray
    intensity: np.ndarray
    owner: np.ndarray
    semantic: np.ndarray
    ring: np.ndarray
    time: np.ndarray


def make_returns(
    hits: Hits, sensor: Sensor, motion: Motion, rng: np.random.Generator, compensated: bool = True
) -> Returns:
    """Convert hits to returns, with noise and losses.

    The power of a return is proportional to brightness / range ** 2. The return is lost if its power
    is below that of a surface of brightness 0.1 that faces the sensor at the range sensor.reach.

    Args:
        hits: First hits of all rays.
        compensated: Apply motion correction, as in KITTI: points are in the sensor's frame at the
            stamp. Otherwise each point is in the sensor's frame at its own time.
    """
    shape = hits.range.shape
    rays = make_rays(sensor, motion if compensated else NO_MOTION)
    noisy_range = hits.range + rng.normal(0.0, sensor.range_noise, shape)
    if sensor.offsets:
        noisy_range += np.asarray(sensor.offsets)
    with np.errstate(divide="ignore", invalid="ignore"):  # inf / inf for rays without a hit
        power = (
            np.log(hits.brightness / 0.1)
            + GRAZING_EXPONENT * np.log(hits.cosine)
            - 2 * np.log(hits.range / sensor.reach)
        )
    scatter = rng.normal(0.0, POWER_SCATTER, (-(-shape[0] // SCATTER_COLUMNS), shape[1]))
    is_kept = power > np.repeat(scatter, SCATTER_COLUMNS, axis=0)[: shape[0]]
    is_kept &= (rng.random(shape) >= sensor.dropout) & sensor.find_unblocked_rays()
    # The margin keeps the ranges within the limits after rounding to float32.
    is_kept &= (noisy_range > sensor.min_range + 1e-4) & (noisy_range < sensor.max_range - 1e-4)
    ring, column = divmod(np.flatnonzero(is_kept.T), shape[0])
    ray = column * shape[1] + ring
    ranges, brightness = hits.range.ravel()[ray], hits.brightness.ravel()[ray]
    xyz = rays.direction.reshape(-1, 3)[ray]
    xyz *= noisy_range.ravel()[ray, None]
    xyz += rays.origin.reshape(-1, 3)[ray]
    intensity = brightness + rng.normal(0.0, INTENSITY_NOISE, len(ring))
    if sensor.fade[1]:
        loss = sensor.fade[1] * np.maximum(ranges - sensor.fade[0], 0.0)
        intensity -= np.where(brightness < RETROREFLECTOR, loss, 0.0)
    is_zero = (intensity < sensor.floor) | (rng.random(len(intensity)) < sensor.silent)
    if sensor.biases:
        intensity += np.asarray(sensor.biases)[ring]
    intensity = np.where(is_zero, 0.0, np.round(np.clip(intensity, 0.0, 1.0), 2))
    return Returns(
        xyz.astype(np.float32),
        intensity.astype(np.float32),
        hits.owner.ravel()[ray],
        hits.semantic.ravel()[ray],
        ring.astype(np.uint16),
        (sensor.compute_firing_times() - motion.stamp / sensor.rate)[column].astype(np.float32),
    )
