"""Beams are wide: what comes back where a beam meets the edges of things.

Where a ray's neighbours on the grid meet other solids than it does, a second ray is cast, to a
random place in the beam's footprint. So it meets something else with a probability that is the
share of the footprint beyond the edge. A random share of the beam's energy then falls on what the
second ray meets; if both surfaces are within the length of the pulse, they give one return between
them, and the stronger one of the two otherwise.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from lidar_perception.simulation.hashing import hash_uniform

OUTLIER = 1  # SemanticKITTI's class of returns that are from no surface


class RayHit(NamedTuple):
    """What a ray meets: range m, inf where nothing; brightness and cosine of the incidence; owner,
    0 where no object; semantic class, 0 where nothing; solid, -1 where none."""

    range: float
    brightness: float
    cosine: float
    owner: int
    semantic: int
    solid: int


def find_edges(solid: np.ndarray) -> np.ndarray:
    """(columns, rings) bool: a neighbour has another solid."""
    edge = np.zeros(solid.shape, bool)
    other = solid != np.roll(solid, 1, axis=0)
    edge |= other | np.roll(other, -1, axis=0)
    other = solid[:, 1:] != solid[:, :-1]
    edge[:, 1:] |= other
    edge[:, :-1] |= other
    return edge


@njit(cache=True, nogil=True, error_model="numpy")
def draw_in_footprint(way, divergence, key):
    """Direction to a random place, uniform in the disc of the beam along way (x, y, z)."""
    x, y, z = way
    radius = divergence / 2 * math.sqrt(hash_uniform(3, key))
    turn = 2 * np.pi * hash_uniform(4, key)
    aside, up, level = radius * math.cos(turn), radius * math.sin(turn), math.hypot(x, y)
    a = x - aside * y / level - up * z * x / level
    b = y + aside * x / level - up * z * y / level
    c = z + up * level
    long = math.sqrt(a * a + b * b + c * c)
    return a / long, b / long, c / long


@njit(cache=True, nogil=True, error_model="numpy")
def merge_hits(one, other, pulse, key):
    """The Met of a beam whose two rays meet one and other."""
    if one.solid == other.solid:
        return one
    share = hash_uniform(5, key)  # of other
    first, second = one.brightness * (1 - share), other.brightness * share
    if one.range < np.inf and other.range < np.inf and abs(one.range - other.range) < pulse:
        return RayHit(one.range * (1 - share) + other.range * share, first + second,
                      one.cosine * (1 - share) + other.cosine * share,
                      one.owner if one.owner == other.owner else 0,
                      one.semantic if one.semantic == other.semantic else OUTLIER,
                      other.solid if share > 0.5 else one.solid)
    # An empty ray has no power: 0 / inf.
    if second / other.range ** 2 > first / one.range ** 2:
        return RayHit(other.range, second, other.cosine, other.owner, other.semantic, other.solid)
    return RayHit(one.range, first, one.cosine, one.owner, one.semantic, one.solid)
