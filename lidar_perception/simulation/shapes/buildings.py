"""Buildings with glazed fronts."""

from __future__ import annotations

import numpy as np

from lidar_perception.simulation.shapes.primitives import GLASS, METAL, block
from lidar_perception.simulation.solids import make_parts

BUILDING = 50
FOOT_M = -1.0  # z of the bottom of a house
ROOM_DEPTH_M = 3.0  # depth of the rooms behind the front


def make_building(rng: np.random.Generator, length: float, depth: float, storeys: int) -> np.ndarray:
    """Make a house as (P,) PART, centred along x, with its front at y = 0 facing -y.

    Piers and ceilings frame the windows, and some beams pass through their glass. The base, sills,
    balconies and the edge of the roof protrude by up to 1.2 m. A house of 15 m and four storeys has
    at most 40 parts.

    Args:
        length, depth: Size in m; the depth is at least 4 m.
        storeys: Number of storeys, at least 1.
    """
    x, tone = length / 2, rng.uniform(0.25, 0.55)  # interquartile range of walls in SemanticKITTI: 0.34 to 0.52
    ground_height, storey_height = rng.uniform(2.9, 3.8), rng.uniform(2.7, 3.2)
    floors = [ground_height + storey_height * i for i in range(storeys)]  # tops of the ceilings
    top = floors[-1]
    count = max(int(length / rng.uniform(2.8, 4.0)), 1)
    pitch, pier_fraction = length / count, rng.uniform(0.35, 0.6)
    pier_positions = [(i - count / 2) * pitch for i in range(count + 1)]
    rows = [block((-x, ROOM_DEPTH_M, FOOT_M), (x, depth, top), 0.2)]
    rows += [
        block(
            (max(pier_x - pier_fraction * pitch / 2, -x), 0, FOOT_M),
            (min(pier_x + pier_fraction * pitch / 2, x), 0.35, top),
            tone,
        )
        for pier_x in pier_positions
    ]
    rows += [block((side * x, 0.3, FOOT_M), (side * (x - 0.3), depth, top), tone) for side in (-1, 1)]
    sill = rng.uniform(0.8, 1.0)
    for below, above in zip([0.0, *floors[:-1]], floors):
        rows += [
            block((-x, 0.02, above - 0.55), (x, ROOM_DEPTH_M, above), tone),
            block((-x, 0.02, below if below else FOOT_M), (x, 0.33, below + sill), tone),
            block((-x, 0.15, below + sill), (x, 0.17, above - 0.55), GLASS, transmission=rng.uniform(0.5, 0.75)),
        ]
    door = (pier_positions[count // 2] + pier_positions[count // 2 + 1]) / 2 if count > 1 else 0.0
    half_width = (1 - pier_fraction) * pitch / 2
    rows += [
        block((door - half_width, 0.0, FOOT_M), (door + half_width, 0.1, 2.1), 0.25),
        block((door - half_width - 0.1, -0.1, -0.3), (door + half_width + 0.1, 0.0, 0.15), 0.4),
        block((-x, -0.05, FOOT_M), (x, 0.0, rng.uniform(0.4, 0.8)), 0.8 * tone),
        block((-x, -rng.uniform(0.2, 0.6), top), (x, depth, top + 0.25), 0.3),
    ]
    if rng.random() < 0.6:  # the ridge of the roof
        rows.append(block((-x, 0.3 * depth, top), (x, 0.7 * depth, top + rng.uniform(1.5, 3.0)), 0.3))
    rows += [row for below in floors[:-1] for row in _decorate_front(rng, below, sill, x, pier_positions, pitch)]
    return make_parts(rows, BUILDING)


def make_glass_hall(rng: np.random.Generator, length: float, depth: float) -> np.ndarray:
    """Make a hall as (P,) PART, centred along x, with a glass front at y = 0 facing -y.

    Some beams pass through the glass and hit columns and walls inside. The roof protrudes. A hall of
    30 m has at most 40 parts.
    """
    x, height, tone = length / 2, rng.uniform(3.5, 8.0), rng.uniform(0.35, 0.6)
    post_positions = np.linspace(-x, x, max(int(length / rng.uniform(1.8, 3.5)), 1) + 1)
    rows = [
        block((-x, 0.04, 0.05), (x, 0.06, height), GLASS, transmission=rng.uniform(0.5, 0.85)),
        block((-x, 0.0, FOOT_M), (x, 0.1, rng.uniform(0.05, 0.3)), METAL),
        block((-x, 0.0, 2.3), (x, 0.1, 2.45), METAL),
        block((-x, depth - 0.3, FOOT_M), (x, depth, height), tone),
        block((-x - 0.3, -rng.uniform(0.2, 3.0), height), (x + 0.3, depth, height + 0.5), tone),
    ]
    rows += [block((s * x, 0.0, FOOT_M), (s * (x - 0.3), depth, height), tone) for s in (-1, 1)]
    rows += [block((post_x - 0.04, -0.03, FOOT_M), (post_x + 0.04, 0.15, height), METAL) for post_x in post_positions]
    columns = rng.uniform((-0.9 * x, 1.5, 0.1, 0.9), (0.9 * x, depth - 1.0, 0.5, height), (4, 4))
    rows += [
        block((post_x - half_width, y - half_width, FOOT_M), (post_x + half_width, y + half_width, top), 0.4)
        for post_x, y, half_width, top in columns.tolist()
    ]
    return make_parts(rows, BUILDING)


def _decorate_front(
    rng: np.random.Generator, below: float, sill: float, x: float, pier_positions: list[float], pitch: float
) -> list[tuple]:
    """Return the parts of a sill along an upper storey, or of a balcony, or no parts."""
    pick = rng.random()
    if pick < 0.35:
        return [block((-x, -0.08, below + sill - 0.08), (x, 0.05, below + sill), 0.4)]
    if pick < 0.7 and len(pier_positions) > 2:
        left = pier_positions[rng.integers(len(pier_positions) - 1)]
        rail_y = -rng.uniform(0.8, 1.2)
        return [
            block((left, rail_y, below - 0.15), (left + pitch, 0, below), 0.4),
            block((left, rail_y, below), (left + pitch, rail_y + 0.04, below + 1.0), METAL, transmission=0.5),
        ]
    return []
