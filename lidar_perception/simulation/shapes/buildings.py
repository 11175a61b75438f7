"""Buildings: a front with glazed openings and rooms behind."""

from __future__ import annotations

import numpy as np

from lidar_perception.simulation.shapes.thing import GLASS, METAL, block
from lidar_perception.simulation.solids import parts

BUILDING = 50
FOOT_M = -1.0  # bottom of a house, sunk into the ground
ROOM_DEPTH_M = 3.0  # depth of rooms behind the front


def make_building(rng: np.random.Generator, length: float, depth: float, storeys: int) -> np.ndarray:
    """Make a house (P,) PART along x, centred, with its front at y = 0 towards -y.

    The windows are between piers and the floors; beams pass the glass at random. Base, sills,
    balconies and the edge of the roof protrude by up to 1.2 m. The depth is at least 4 m. At most
    40 parts for 15 m and four storeys.
    """
    x, tone = length / 2, rng.uniform(0.25, 0.55)  # the middle half in SemanticKITTI is 0.34 to 0.52
    ground, storey = rng.uniform(2.9, 3.8), rng.uniform(2.7, 3.2)
    floors = [ground + storey * i for i in range(storeys)]  # heights of the upper faces of the ceilings
    top = floors[-1]
    wall = dict(reflectance=tone)
    count = max(int(length / rng.uniform(2.8, 4.0)), 1)
    pitch, pier = length / count, rng.uniform(0.35, 0.6)
    places = [(i - count / 2) * pitch for i in range(count + 1)]
    rows = [block((-x, ROOM_DEPTH_M, FOOT_M), (x, depth, top), reflectance=0.2)]
    rows += [
        block((max(at - pier * pitch / 2, -x), 0, FOOT_M), (min(at + pier * pitch / 2, x), 0.35, top), **wall)
        for at in places
    ]
    rows += [block((side * x, 0.3, FOOT_M), (side * (x - 0.3), depth, top), **wall) for side in (-1, 1)]
    sill = rng.uniform(0.8, 1.0)
    for below, above in zip([0.0, *floors[:-1]], floors):
        rows += [
            block((-x, 0.02, above - 0.55), (x, ROOM_DEPTH_M, above), **wall),
            block((-x, 0.02, below if below else FOOT_M), (x, 0.33, below + sill), **wall),
            block(
                (-x, 0.15, below + sill),
                (x, 0.17, above - 0.55),
                reflectance=GLASS,
                transmission=rng.uniform(0.5, 0.75),
            ),
        ]
    door = (places[count // 2] + places[count // 2 + 1]) / 2 if count > 1 else 0.0
    half = (1 - pier) * pitch / 2
    rows += [
        block((door - half, 0.0, FOOT_M), (door + half, 0.1, 2.1), reflectance=0.25),
        block((door - half - 0.1, -0.3, -0.3), (door + half + 0.1, 0.0, 0.15), reflectance=0.4),
        block((-x, -0.05, FOOT_M), (x, 0.0, rng.uniform(0.4, 0.8)), reflectance=0.8 * tone),
        block((-x, -rng.uniform(0.2, 0.6), top), (x, depth, top + 0.25), reflectance=0.3),
    ]
    if rng.random() < 0.6:  # a roof with a ridge
        rows.append(block((-x, 0.3 * depth, top), (x, 0.7 * depth, top + rng.uniform(1.5, 3.0)), reflectance=0.3))
    rows += [row for below in floors[:-1] for row in _decorate_front(rng, below, sill, x, places, pitch)]
    return parts(rows, BUILDING)


def make_glass_hall(rng: np.random.Generator, length: float, depth: float) -> np.ndarray:
    """Make a hall (P,) PART along x, centred, with a glass front between posts at y = 0 towards -y.

    Beams pass the glass at random, and then hit columns and walls inside. The roof protrudes. At
    most 40 parts for 30 m.
    """
    x, high, wall = length / 2, rng.uniform(3.5, 8.0), dict(reflectance=rng.uniform(0.35, 0.6))
    posts = np.linspace(-x, x, max(int(length / rng.uniform(1.8, 3.5)), 1) + 1)
    rows = [
        block((-x, 0.04, 0.05), (x, 0.06, high), reflectance=GLASS, transmission=rng.uniform(0.5, 0.85)),
        block((-x, 0.0, FOOT_M), (x, 0.1, rng.uniform(0.05, 0.3)), reflectance=METAL),
        block((-x, 0.0, 2.3), (x, 0.1, 2.45), reflectance=METAL),
        block((-x, depth - 0.3, FOOT_M), (x, depth, high), **wall),
        block((-x - 0.3, -rng.uniform(0.2, 3.0), high), (x + 0.3, depth, high + 0.5), **wall),
    ]
    rows += [block((s * x, 0.0, FOOT_M), (s * (x - 0.3), depth, high), **wall) for s in (-1, 1)]
    rows += [block((at - 0.04, -0.03, FOOT_M), (at + 0.04, 0.15, high), reflectance=METAL) for at in posts]
    inside = rng.uniform((-0.9 * x, 1.5, 0.1, 0.9), (0.9 * x, depth - 1.0, 0.5, high), (4, 4))
    rows += [
        block((at - half, y - half, FOOT_M), (at + half, y + half, top), reflectance=0.4)
        for at, y, half, top in inside.tolist()
    ]
    return parts(rows, BUILDING)


def _decorate_front(
    rng: np.random.Generator, below: float, sill: float, x: float, places: list[float], pitch: float
) -> list[tuple]:
    """Return a sill along an upper storey, a balcony, or nothing."""
    pick = rng.random()
    if pick < 0.35:
        return [block((-x, -0.08, below + sill - 0.08), (x, 0.05, below + sill), reflectance=0.4)]
    if pick < 0.7 and len(places) > 2:
        left = places[rng.integers(len(places) - 1)]
        out = -rng.uniform(0.8, 1.2)
        return [
            block((left, out, below - 0.15), (left + pitch, 0, below), reflectance=0.4),
            block((left, out, below), (left + pitch, out + 0.04, below + 1.0), reflectance=METAL, transmission=0.5),
        ]
    return []
