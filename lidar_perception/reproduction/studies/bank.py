"""Templates of one simulated walker, by range and by the side that the sensor sees."""

from __future__ import annotations

import functools

import numpy as np

from lidar_perception.candidates.seeds import MIN_POINTS, Seed
from lidar_perception.simulation.raycast import cast_rays
from lidar_perception.simulation.returns import make_returns
from lidar_perception.simulation.sensor import HDL64E, NO_MOTION
from lidar_perception.simulation.shapes.people import make_pedestrian
from lidar_perception.simulation.solids import place_parts
from lidar_perception.simulation.terrain import Ground

FRONT, SIDE = np.pi, np.pi / 2  # where the walker looks, against the sensor's view
RANGES = (7.5, 15.0, 22.5, 30.0, 40.0)
WALKING = 1.4  # m/s
UNDERGROUND = np.array([0.0, 0.0, 1e4])  # the sensor's place over a ground that it never meets


@functools.cache
def template_bank() -> dict[tuple[float, float], Seed]:
    """(range in metres, FRONT or SIDE) -> seed; ranges without 10 points are left out."""
    walker = make_pedestrian(np.random.default_rng(0), WALKING)
    made, height = walker.parts(0.0), walker.size[2]
    bank = {}
    for far in RANGES:
        for view in (FRONT, SIDE):
            base = np.tile([far, 0.0, -HDL64E.height], (len(made), 1))
            solids = place_parts(made, base, np.full(len(made), view), np.ones(len(made)),
                                 np.zeros((len(made), 3)))
            hits = cast_rays(solids, Ground(), UNDERGROUND, HDL64E, NO_MOTION)
            xyz = make_returns(hits, HDL64E, NO_MOTION, np.random.default_rng(0)).xyz
            if len(xyz) >= MIN_POINTS:
                bank[far, view] = Seed(xyz, -HDL64E.height, height)
    return bank
