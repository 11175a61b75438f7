"""Trees, bushes and hedges: crowns that let some beams through."""

from __future__ import annotations

import numpy as np

from lidar_perception.simulation.shapes.thing import rod
from lidar_perception.simulation.solids import BOX, ELLIPSOID, part, parts

VEGETATION, TRUNK = 70, 71
BARK, LEAVES = 0.31, 0.34  # medians of trunk and vegetation in a scan of SemanticKITTI


def tree(rng: np.random.Generator, height: float | None = None) -> np.ndarray:
    """(P,) PART of a broad-leaved tree so many metres high, drawn if not given: a trunk, three
    boughs, a crown and three tufts, none below a third of the height. Its foot is 0.3 m in the
    ground."""
    height = rng.uniform(4.0, 11.0) if height is None else height
    fork, radius = height * rng.uniform(0.33, 0.42), height * rng.uniform(0.016, 0.026)
    top = (*rng.uniform(-0.03, 0.03, 2) * height, 0.75 * height)
    rows = [rod((0, 0, -0.3), (0, 0, fork), radius, reflectance=BARK),
            rod((0, 0, fork), top, 0.6 * radius, reflectance=BARK)]
    turn, spread = rng.uniform(0, 2 * np.pi), height * rng.uniform(0.1, 0.2)
    for at in turn + np.arange(2) * np.pi:
        end = (spread * np.cos(at), spread * np.sin(at), 0.62 * height)
        rows.append(rod((0, 0, fork), end, 0.4 * radius, reflectance=BARK))
    made = parts(rows, TRUNK)
    wide, tall = height * rng.uniform(0.2, 0.3), height - fork
    leaves = [_foliage(rng, (0, 0, fork + 0.55 * tall), (wide, wide, 0.45 * tall), (0.4, 1.0))]
    for at in turn + 1.0 + np.arange(3) * 2.1:
        small = height * rng.uniform((0.12, 0.12, 0.1), (0.2, 0.2, 0.16))
        leaves.append(_foliage(rng, (0.7 * wide * np.cos(at), 0.7 * wide * np.sin(at),
                                     fork + tall * rng.uniform(0.25, 0.7)), small, (0.6, 2.0)))
    return np.concatenate([made, parts(leaves, VEGETATION)])


def conifer(rng: np.random.Generator) -> np.ndarray:
    """(P,) PART of a conifer with boughs down to the ground."""
    height = rng.uniform(2.5, 9.0)
    stem = parts([rod((0, 0, -0.3), (0, 0, 0.8 * height), 0.015 * height, reflectance=BARK)], TRUNK)
    tall = 0.2 * height
    rows = [_foliage(rng, (0, 0, max(z * height, tall + 0.1)), (r * height, r * height, tall),
                     (1.0, 2.0)) for z, r in ((0.2, 0.2), (0.4, 0.16), (0.6, 0.11), (0.8, 0.06))]
    return np.concatenate([stem, parts(rows, VEGETATION)])


def bush(rng: np.random.Generator) -> np.ndarray:
    """(P,) PART of a bush, 0.6 to 2 m high: three overlapping balls of leaves."""
    high = rng.uniform(0.3, 1.0)
    rows = [_foliage(rng, (*rng.uniform(-0.5, 0.5, 2) * high, 0.8 * high),
                     high * rng.uniform((0.6, 0.6, 0.8), (1.1, 1.1, 1.2)), (1.5, 5.0))
            for _ in range(3)]
    return parts(rows, VEGETATION)


def hedge(rng: np.random.Generator, length: float) -> np.ndarray:
    """(P,) PART of a hedge so long along x, centred, with an uneven top; its foot is 0.3 m in the
    ground."""
    height, half = rng.uniform(0.8, 2.0), rng.uniform(0.25, 0.5)
    rows = [part(BOX, (0, 0, height / 2 - 0.15), (length / 2, half, height / 2 + 0.15),
                 reflectance=LEAVES, density=rng.uniform(4, 10))]
    rows += [_foliage(rng, (x, 0, height), (length / 8, 1.1 * half, rng.uniform(0.08, 0.2)),
                      (2, 6)) for x in np.linspace(-0.38, 0.38, 4) * length]
    return parts(rows, VEGETATION)


def _foliage(rng: np.random.Generator, centre: tuple, half: tuple, density: tuple) -> tuple:
    return part(ELLIPSOID, tuple(centre), tuple(half), yaw=rng.uniform(0, np.pi),
                reflectance=LEAVES * rng.uniform(0.8, 1.25), density=rng.uniform(*density))
