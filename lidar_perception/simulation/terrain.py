"""The ground: a street with curbs, and the rays that meet it. World frame: x along the street, y
left, z up, metres."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit


class Ground(NamedTuple):
    """A sloped plane with long waves; beyond the curbs it lies curb_height higher."""

    slope_x: float = 0.0
    slope_y: float = 0.0
    wave: float = 0.0            # amplitude, m
    wavelength: float = 25.0     # m
    curb_left: float = 1e9       # y of the curbs, m
    curb_right: float = -1e9
    curb_height: float = 0.0
    road: float = 0.3            # reflectances
    sidewalk: float = 0.4


@njit(cache=True)
def shine(reflectance, cosine):
    """Softer than Lambert's law: rough surfaces still shine back at a grazing angle."""
    return reflectance * (0.5 + 0.5 * cosine)


@njit(cache=True)
def ground_height(ground, x, y):
    """Height of the road, without curbs, at x, y in the world."""
    turns = 2 * np.pi / ground.wavelength
    return (ground.slope_x * x + ground.slope_y * y
            + ground.wave * np.sin(turns * x) * np.cos(turns * y))


@njit(cache=True)
def surface_height(ground, x, y):
    """Height of what one stands on at x, y: the road or the sidewalk."""
    on_road = ground.curb_right < y < ground.curb_left
    return ground_height(ground, x, y) + (0.0 if on_road else ground.curb_height)


@njit(cache=True)
def _meet_surface(ground, position, direction, lift):
    """Range of the road raised by lift; inf if the ray does not come down to it."""
    x, y, z = position
    dx, dy, dz = direction
    closing = dz - ground.slope_x * dx - ground.slope_y * dy
    if closing > -1e-4:
        return np.inf
    t = 0.0
    for _ in range(8):  # Newton's method with the slope of the plane
        gap = z + t * dz - ground_height(ground, x + t * dx, y + t * dy) - lift
        t -= gap / closing
    return t if abs(gap) < 0.02 else np.inf


@njit(cache=True)
def cast_ground(ground, position, directions, max_range):
    """Distance and brightness (columns, rings) of the ground along directions (columns, rings, 3)
    from position; inf and 0 beyond max_range."""
    columns, rings = directions.shape[:2]
    nearest = np.full((columns, rings), np.inf)
    brightness = np.zeros((columns, rings))
    for c in range(columns):
        for r in range(rings):
            direction = directions[c, r]
            t = _meet_surface(ground, position, direction, 0.0)
            y = position[1] + t * direction[1] if t < np.inf else 0.0
            reflectance, cosine = ground.road, abs(direction[2])
            if direction[1] != 0.0 and not (t < np.inf
                                            and ground.curb_right < y < ground.curb_left):
                curb = ground.curb_left if direction[1] > 0 else ground.curb_right
                at_curb = (curb - position[1]) / direction[1]
                gap = position[2] + at_curb * direction[2] - ground_height(
                    ground, position[0] + at_curb * direction[0], curb)
                reflectance = ground.sidewalk
                if gap < ground.curb_height:
                    t, cosine = at_curb, abs(direction[1])
                else:
                    t = _meet_surface(ground, position, direction, ground.curb_height)
            if t <= max_range:
                nearest[c, r] = t
                brightness[c, r] = shine(reflectance, cosine)
    return nearest, brightness
