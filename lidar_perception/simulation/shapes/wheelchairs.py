"""People in wheelchairs."""

from __future__ import annotations

import numpy as np

from lidar_perception.simulation.shapes.people import OTHER, make_sitting_person
from lidar_perception.simulation.shapes.thing import METAL, RUBBER, Thing, block, disc, make_rigid
from lidar_perception.simulation.solids import parts

SPOKE_TRANSMISSION = 0.6  # share of the beams that pass between the spokes


def make_wheelchair(rng: np.random.Generator) -> Thing:
    """Make a person in a wheelchair: a Person_sitting whose box includes the chair."""
    person = make_sitting_person(rng, chair=False)
    (length, width, height), radius = person.size, rng.uniform(0.28, 0.32)
    y, back = width / 2 - 0.03, -length / 2 + 0.3
    wheels = [disc((back, s * y, radius), radius, 0.02, reflectance=RUBBER,
                   transmission=SPOKE_TRANSMISSION) for s in (-1, 1)]
    wheels += [disc((length / 2 - 0.15, s * 0.8 * y, 0.1), 0.1, 0.02, reflectance=RUBBER)
               for s in (-1, 1)]
    seat = [block((back - 0.2, -0.9 * y, 0.4), (back + 0.25, 0.9 * y, 0.44), reflectance=METAL),
            block((back - 0.25, -0.9 * y, 0.44), (back - 0.2, 0.9 * y, 0.9), reflectance=METAL)]
    made = np.concatenate([person.parts(0.0), parts(wheels + seat, OTHER)])
    return make_rigid(made, (length, width, height), person.label)
