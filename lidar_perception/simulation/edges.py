"""Returns of beams that hit the edge of an object.

If a ray's neighbours on the grid hit other solids, a second ray is cast to a random place in the
beam's footprint, so the chance of hitting another solid is the share of the footprint beyond the
edge. A random share of the energy falls on the second hit. If both surfaces are within the length
of the pulse, they give one return between them, otherwise the stronger one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from lidar_perception.simulation.hashing import hash_uniform

OUTLIER = 1  # SemanticKITTI class of returns that do not come from a surface


class RayHit(NamedTuple):
    """The first hit of a ray.

    Attributes:
        range: Metres, inf without a hit.
        brightness, cosine: Brightness and cosine of the incidence.
        owner: Object, 0 for none.
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
    """Return (columns, rings) bool: a neighbouring ray hits another solid."""
    edge = np.zeros(solid.shape, bool)
    other = solid != np.roll(solid, 1, axis=0)
    edge |= other | np.roll(other, -1, axis=0)
    other = solid[:, 1:] != solid[:, :-1]
    edge[:, 1:] |= other
    edge[:, :-1] |= other
    return edge


@njit(cache=True, nogil=True, error_model="numpy")
def draw_in_footprint(way, divergence, key):
    """Draw a direction uniformly in the disc of a beam along way (x, y, z)."""
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
    """Merge the hits of the two rays of a beam."""
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
    # For a ray without a hit the power is 0 / inf = 0.
    if second / other.range**2 > first / one.range**2:
        return RayHit(other.range, second, other.cosine, other.owner, other.semantic, other.solid)
    return RayHit(one.range, first, one.cosine, one.owner, one.semantic, one.solid)
