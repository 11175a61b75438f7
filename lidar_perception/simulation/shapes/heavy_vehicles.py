"""Trucks, buses and trams."""

from __future__ import annotations

import numpy as np

from lidar_perception.simulation.shapes.primitives import (
    GLASS,
    METAL,
    PLATE,
    RUBBER,
    block,
    disc,
    ellipsoid,
    rod,
    slope,
    upright_pane,
)
from lidar_perception.simulation.shapes.scene_object import SceneObject, draw_size, make_rigid
from lidar_perception.simulation.shapes.vehicles import draw_paint
from lidar_perception.simulation.solids import make_parts

TRUCK, ON_RAILS, OTHER_VEHICLE = 18, 16, 20


def make_truck(rng: np.random.Generator) -> SceneObject:
    """Make a truck with a closed body, or with an open load that is lower than the cab."""
    length, width, height = size = draw_size(rng, "Truck")
    is_open = rng.random() < 0.25
    load_height = rng.uniform(1.6, 2.2) if is_open else height
    cab_height = height if is_open else min(height, rng.uniform(2.7, 3.1))
    parts = _make_truck_parts(length, width, load_height, cab_height, max(draw_paint(rng), 0.1), rng.uniform(0.2, 0.6))
    return make_rigid(parts, size, "Truck")


def _make_truck_parts(
    length: float, width: float, load_height: float, cab_height: float, colour: float, cargo: float
) -> np.ndarray:
    """Return the parts of a truck; `colour` and `cargo` are the reflectances of the cab and the load."""
    x, y, radius, floor = length / 2, width / 2, 0.48, 1.15
    back, belt, roof = x - min(2.2, 0.24 * length), 0.62 * cab_height, cab_height - 0.25
    transmission = 0.75  # fraction of beams that pass through the windows
    rows = [
        block((-x, -y, floor), (back - 0.35, y, load_height), cargo),
        block((0.3 - x, -0.45, 0.6), (back, 0.45, floor), 0.1),
        block((back, -0.97 * y, 0.95), (x - 0.1, 0.97 * y, belt), colour),
        block((back, -0.97 * y, roof), (x - 0.15, 0.97 * y, cab_height), colour),
        block((back, -0.97 * y, belt), (back + 0.5, 0.97 * y, roof), colour),
        block((x - 0.35, -0.97 * y, 0.3), (x, 0.97 * y, 0.95), 0.5 * colour),
        slope((x - 0.08, belt), (x - 0.22, roof), 0.93 * y, GLASS, transmission=transmission),
        block((back + 0.6, 0.2 * y, 1.2), (back + 0.75, 0.75 * y, roof - 0.3), 0.12),
        ellipsoid((back + 0.95, 0.47 * y, belt), (0.15, 0.23, 0.45), 0.25),
        block((0.05 - x, -0.9 * y, 0.5), (0.12 - x, 0.9 * y, 0.62), 0.2),
        block((-x + 0.02, -0.3, 0.65), (-x + 0.04, 0.3, 0.78), PLATE),
    ]
    for side in (-1, 1):
        rows += [
            upright_pane(
                (back + 0.5, x - 0.15),
                (side * 0.96 * y, belt),
                (side * 0.96 * y, roof),
                GLASS,
                transmission=transmission,
            ),
            rod((x - 0.13, side * 0.94 * y, belt), (x - 0.2, side * 0.94 * y, roof), 0.05, colour),
            block((x - 0.5, side * (y + 0.05), belt + 0.1), (x - 0.4, side * (y + 0.25), belt + 0.6), 0.1),
            block((-0.1 * x, side * 0.9 * y, 0.5), (0.25 * x, side * 0.5 * y, 1.0), METAL),
            block((-x, side * 0.7 * y, 0.85), (0.02 - x, side * 0.98 * y, 1.0), PLATE),
        ]
        rows += [
            disc((wheel_x, side * (y - 0.2), radius), radius, 0.18, RUBBER) for wheel_x in (x - 1.2, 1.4 - x, 2.6 - x)
        ]
    return make_parts(rows, TRUCK)


def make_bus(rng: np.random.Generator) -> SceneObject:
    """Make a city bus of 10.5 to 13 m."""
    size = (rng.uniform(10.5, 13.0), rng.uniform(2.45, 2.55), rng.uniform(2.9, 3.2))
    parts = _make_coach_parts(size, max(draw_paint(rng), 0.15), OTHER_VEHICLE, 0.5, (2.2 / size[0], 0.78))
    return make_rigid(parts, size, "Misc")


def make_tram(rng: np.random.Generator) -> SceneObject:
    """Make a tram, or one section of a tram."""
    size = draw_size(rng, "Tram")
    parts = _make_coach_parts(size, max(draw_paint(rng), 0.15), ON_RAILS, 0.38, (0.18, 0.82))
    return make_rigid(parts, size, "Tram")


def _make_coach_parts(
    size: tuple[float, float, float], colour: float, semantic: int, radius: float, axles: tuple[float, float]
) -> np.ndarray:
    """Return the parts of a bus or tram: body with windows and pillars, seats and wheels.

    `axles` are the positions of the axles from the tail, as fractions of the length.
    """
    length, width, height = size
    x, y = length / 2, width / 2
    belt, top, floor = 0.38 * height, 0.82 * height, 0.45
    transmission = 0.7  # fraction of beams that pass through the windows
    rows = [
        block((0.4 - x, -0.97 * y, top), (x - 0.4, 0.97 * y, height), colour),
        block((0.3 - x, -0.95 * y, 0.25), (x - 0.3, 0.95 * y, floor), 0.15),
    ]
    for end in (-1, 1):
        screen = (end * (x - 0.15), belt), (end * (x - 0.4), top + 0.1)
        rows += [
            ellipsoid((end * (x - 0.6), 0, 0.22 + belt / 2), (0.6, 0.98 * y, belt / 2), colour),
            block((end * (x - 0.7), -0.93 * y, 0.25), (end * (x - 0.2), 0.93 * y, belt), colour),
            slope(max(screen), min(screen), 0.93 * y, GLASS, transmission=transmission),
        ]
    for side in (-1, 1):
        rows += [
            block((0.6 - x, side * y, 0.28), (x - 0.6, side * (y - 0.06), belt), colour),
            upright_pane(
                (0.4 - x, x - 0.4), (side * 0.99 * y, belt), (side * 0.95 * y, top), GLASS, transmission=transmission
            ),
        ]
        rows += [
            disc(((fraction - 0.5) * length, side * (y - 0.16), radius), radius, 0.15, RUBBER) for fraction in axles
        ]
        rows += [
            rod((part_x, side * 0.93 * y, belt), (part_x, side * 0.91 * y, top), 0.07, colour)
            for part_x in np.linspace(0.45 - x, x - 0.45, 6)
        ]
    rows += [
        block((part_x, -0.85 * y, floor), (part_x + 0.2, 0.85 * y, belt + 0.35), 0.2, transmission=0.4)
        for part_x in np.linspace(1.5 - x, x - 3, 3)
    ]
    return make_parts(rows, semantic)
