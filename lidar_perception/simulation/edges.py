"""Returns of beams that hit the edge of an object.

If neighbouring rays hit different solids, a second ray is cast to a random point in the footprint of
the beam. A random fraction of the energy falls on the second hit. Hits that are closer together than
the pulse length give one return between them. Otherwise the stronger hit gives the return.
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
        solid: Index of the solid, -1 if no solid was hit.
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
    is_edge = differs | np.roll(differs, -1, axis=0)
    differs = solid[:, 1:] != solid[:, :-1]
    is_edge[:, 1:] |= differs
    is_edge[:, :-1] |= differs
    return is_edge


@njit(cache=True, nogil=True, error_model="numpy")
def draw_in_footprint(direction, divergence, key):
    """Draw a unit vector uniformly in the footprint of a beam with this direction (x, y, z)."""
    x, y, z = direction
    radius = divergence / 2 * math.sqrt(hash_uniform(3, key))
    angle = 2 * np.pi * hash_uniform(4, key)
    left, up, horizontal = radius * math.cos(angle), radius * math.sin(angle), math.hypot(x, y)
    a = x - left * y / horizontal - up * z * x / horizontal
    b = y + left * x / horizontal - up * z * y / horizontal
    c = z + up * horizontal
    length = math.sqrt(a * a + b * b + c * c)
    return a / length, b / length, c / length


@njit(cache=True, nogil=True, error_model="numpy")
def merge_hits(one, other, pulse, key):
    """Merge the hits of a beam's two rays into one RayHit."""
    if one.solid == other.solid:
        return one
    fraction = hash_uniform(5, key)  # fraction of the energy on the other hit
    power, other_power = one.brightness * (1 - fraction), other.brightness * fraction
    if one.range < np.inf and other.range < np.inf and abs(one.range - other.range) < pulse:
        return RayHit(
            one.range * (1 - fraction) + other.range * fraction,
            power + other_power,
            one.cosine * (1 - fraction) + other.cosine * fraction,
            one.owner if one.owner == other.owner else 0,
            one.semantic if one.semantic == other.semantic else OUTLIER,
            other.solid if fraction > 0.5 else one.solid,
        )
    # The power of a ray without a hit is 0 / inf = 0.
    if other_power / other.range**2 > power / one.range**2:
        return RayHit(other.range, other_power, other.cosine, other.owner, other.semantic, other.solid)
    return RayHit(one.range, power, one.cosine, one.owner, one.semantic, one.solid)
