"""Solids and ground for tests of the ray caster."""

from dataclasses import replace

import numpy as np

from lidar_perception.simulation.sensor import make_generic_sensor
from lidar_perception.simulation.solids import Solids
from lidar_perception.simulation.terrain import Ground

SENSOR = make_generic_sensor(
    24, -24.0, 12.0, 1.0, 10.0, height=1.7, max_range=60.0, divergence=0.0, lifts=tuple(np.linspace(0.2, 0.0, 24))
)
OVER_ROAD = np.array([0.0, 0.0, SENSOR.height])
FULL = Ground(0.01, -0.02, 0.05, 20.0, 0.02, 6.0, -4.0, 0.13, 2.0, ((8.0, 15.0), (-30.0, -22.0)), 1.5)


def make_solids(
    kind, centre, half_size, owner=1, axes=None, density=np.inf, transmission=0.0, velocity=(0.0, 0.0, 0.0)
):
    """Return solids of P kinds, centres and half sizes; other attributes are given per solid or for all."""
    kind, centre = np.atleast_1d(np.array(kind, np.int8)), np.atleast_2d(np.array(centre, float))
    n = len(kind)
    axes = np.eye(3) if axes is None else axes
    return Solids(
        kind,
        centre,
        np.broadcast_to(np.array(half_size, float), (n, 3)),
        np.broadcast_to(axes, (n, 3, 3)),
        np.full(n, 0.5),
        np.full(n, 10, np.uint16),
        np.broadcast_to(float(density), n),
        np.broadcast_to(float(transmission), n),
        np.broadcast_to(owner, n).astype(np.int32),
        np.broadcast_to(np.array(velocity, float), (n, 3)),
    )


def make_crowd(seed, count=60, moving=True):
    """Return random solids of all kinds around the sensor, some of them far away."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    bearing, distance = rng.uniform(-np.pi, np.pi, count), rng.uniform(4, 70, count)
    centre = np.stack([distance * np.cos(bearing), distance * np.sin(bearing), rng.uniform(-3, 2, count)], 1)
    solids = make_solids(
        rng.integers(0, 3, count),
        centre,
        rng.uniform(0.05, 2.0, (count, 3)),
        np.sort(rng.integers(0, 20, count)),
        axes,
        velocity=rng.normal(0, 8, (count, 3)) * moving,
    )
    return replace(solids, reflectance=rng.uniform(0.1, 0.9, count))
