"""Returns of beams that hit the edge of an object.

If neighbouring rays hit different solids, a second ray is cast to a random point in the footprint of
the beam. A random share of the energy falls on the second hit. If the hits are closer than the
length of the pulse, they give one return between them, otherwise the stronger one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from lidar_perception.simulation.hashing import hash_uniform

OUTLIER = 1  # SemanticKITTI class of returns between two surfaces


class RayHit(NamedTuple):
    """First hit of a ray.

    Attributes:
        range: Metres, inf without a hit.
        brightness: Brightness, 0 .. 1.
        cosine: Cosine of the angle of incidence.
        owner: Track id of the object, 0 for none.
        semantic: SemanticKITTI class, 0 without a hit.
        solid: Index of the solid, -1 for none.
    """

    range: float
    brightness: float
    cosine: float
    owner: int
    semantic: int
    solid: int


def find_edges(solid: np.ndarray) -> np.ndarray:
    """Return (columns, rings) bool, True for rays with a neighbour that hits another solid."""
    differs = solid != np.roll(solid, 1, axis=0)
    edge = differs | np.roll(differs, -1, axis=0)
    differs = solid[:, 1:] != solid[:, :-1]
    edge[:, 1:] |= differs
    edge[:, :-1] |= differs
    return edge


@njit(cache=True, nogil=True, error_model="numpy")
def draw_in_footprint(direction, divergence, key):
    """Draw a unit vector uniformly in the footprint of a beam with this direction (x, y, z)."""
    x, y, z = direction
    radius = divergence / 2 * math.sqrt(hash_uniform(3, key))
    turn = 2 * np.pi * hash_uniform(4, key)
    aside, up, level = radius * math.cos(turn), radius * math.sin(turn), math.hypot(x, y)
    a = x - aside * y / level - up * z * x / level
    b = y + aside * x / level - up * z * y / level
    c = z + up * level
    length = math.sqrt(a * a + b * b + c * c)
    return a / length, b / length, c / length


@njit(cache=True, nogil=True, error_model="numpy")
def merge_hits(one, other, pulse, key):
    """Merge the hits of the two rays of a beam into one RayHit."""
    if one.solid == other.solid:
        return one
    share = hash_uniform(5, key)  # fraction of the energy on the other hit
    first, second = one.brightness * (1 - share), other.brightness * share
    if one.range < np.inf and other.range < np.inf and abs(one.range - other.range) < pulse:
        return RayHit(
            one.range * (1 - share) + other.range * share,
            first + second,
            one.cosine * (1 - share) + other.cosine * share,
            one.owner if one.owner == other.owner else 0,
            one.semantic if one.semantic == other.semantic else OUTLIER,
            other.solid if share > 0.5 else one.solid,
        )
    # A ray without a hit has no power: 0 / inf.
    if second / other.range**2 > first / one.range**2:
        return RayHit(other.range, second, other.cosine, other.owner, other.semantic, other.solid)
    return RayHit(one.range, first, one.cosine, one.owner, one.semantic, one.solid)
