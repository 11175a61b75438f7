"""Returns that a sensor reports for the hits of its rays: noise, losses and intensity."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidar_perception.simulation.raycast import Hits
from lidar_perception.simulation.sensor import NO_MOTION, Motion, Sensor, make_rays
from lidar_perception.simulation.solids import RETROREFLECTOR

# Grazing incidence weakens a return by a power of the cosine of the incidence, and the logarithm of
# the power scatters. With these values the road is lost as ahead of KITTI's car, where in 27 scans
# (median) 0.7 of the rays return from 38 m, 0.5 from 43 m, 0.35 from 50 m and none from 60 m.
# Lost returns are adjacent: on a SemanticKITTI scan only 0.03 of the road's returns beyond 35 m are
# missing singly.
GRAZING_EXPONENT = 1 / 3
POWER_SCATTER, SCATTER_COLUMNS = 0.5, 16  # standard deviation of the power; columns with the same value
# Neighbouring points of one beam differ as much on the road, sidewalks (0.03) and facades (0.04) of
# a SemanticKITTI scan (robust standard deviation).
INTENSITY_NOISE = 0.035


class Returns(NamedTuple):
    """The N points of one turn, beam by beam, each counter-clockwise from straight ahead.

    This is the order of KITTI's files.

    Attributes:
        xyz: (N, 3) float32, m in the sensor's frame.
        intensity: (N,) float32, 0..1 in hundredths.
        owner: (N,) int32, see Hits.
        semantic: (N,) uint16, see Hits.
        ring: (N,) uint16, 0 is the highest beam.
        time: (N,) float32, seconds after the stamp.
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
    """Return the points that the sensor reports.

    A return is lost if its power, which is proportional to brightness over range squared, is below
    that of a surface of brightness 0.1 that faces the sensor at sensor.reach.

    Args:
        compensated: Points are in the frame at the stamp, as KITTI publishes them; otherwise as if
            the sensor had not moved.
    """
    shape = hits.range.shape
    turn = make_rays(sensor, motion if compensated else NO_MOTION)
    noisy = hits.range + rng.normal(0.0, sensor.range_noise, shape)
    if sensor.offsets:
        noisy += np.asarray(sensor.offsets)
    with np.errstate(divide="ignore", invalid="ignore"):  # NaN for rays without a hit and an infinite reach
        power = (
            np.log(hits.brightness / 0.1)
            + GRAZING_EXPONENT * np.log(hits.cosine)
            - 2 * np.log(hits.range / sensor.reach)
        )
    scatter = rng.normal(0.0, POWER_SCATTER, (-(-shape[0] // SCATTER_COLUMNS), shape[1]))
    keep = power > np.repeat(scatter, SCATTER_COLUMNS, axis=0)[: shape[0]]
    keep &= (rng.random(shape) >= sensor.dropout) & sensor.open_rays()
    # Slightly within the limits, so that rounding to float32 does not exceed them.
    keep &= (noisy > sensor.min_range + 1e-4) & (noisy < sensor.max_range - 1e-4)
    ring, column = divmod(np.flatnonzero(keep.T), shape[0])
    ray = column * shape[1] + ring
    reached, brightness = hits.range.ravel()[ray], hits.brightness.ravel()[ray]
    xyz = turn.direction.reshape(-1, 3)[ray]
    xyz *= noisy.ravel()[ray, None]
    xyz += turn.origin.reshape(-1, 3)[ray]
    intensity = brightness + rng.normal(0.0, INTENSITY_NOISE, len(ring))
    if sensor.fade[1]:
        faded = sensor.fade[1] * np.maximum(reached - sensor.fade[0], 0.0)
        intensity -= np.where(brightness < RETROREFLECTOR, faded, 0.0)
    weak = (intensity < sensor.floor) | (rng.random(len(intensity)) < sensor.silent)
    if sensor.biases:
        intensity += np.asarray(sensor.biases)[ring]
    intensity = np.where(weak, 0.0, np.round(np.clip(intensity, 0.0, 1.0), 2))
    return Returns(
        xyz.astype(np.float32),
        intensity.astype(np.float32),
        hits.owner.ravel()[ray],
        hits.semantic.ravel()[ray],
        ring.astype(np.uint16),
        (sensor.times() - motion.stamp / sensor.rate)[column].astype(np.float32),
    )
