"""Ground: a sloping road with waves and camber, side streets, sidewalks and grass.

The ground is a smooth relief in the world frame (x along the street, y left, z up, metres), which is
raised by the curb height beyond the curbs. A ray is intersected with the raised relief first. If that
point is on the road, the ray continues to the road or a curb. Bumps, tufts of grass and litter on the
surface may stop the ray earlier.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from lidar_perception.simulation.hashing import hash_uniform
from lidar_perception.simulation.solids import RETROREFLECTOR

ROAD, PARKING, SIDEWALK, GRASS = 40, 44, 48, 72  # SemanticKITTI classes
GRAIN_M = 0.25  # distance between the bumps of a rough surface, m
PATCH = 10  # distance between rough patches, in bumps
BARE_SHARE = 0.45  # approximate fraction of the ground between the patches
PATCH_STEEPNESS = 3.0  # steepness of the edges of patches
BARE_HEIGHT_SHARE = 0.1  # height of bumps between the patches, as a fraction of that in patches
ROAD_HEIGHT_SHARE = 0.06  # height of bumps on the road, as a fraction of that in patches
MAX_TUFT_DISTANCE_M, TUFT_STEPS = 6.0, 8  # length of a grazing ray to search for tufts, and number of steps


class Ground(NamedTuple):
    """Parameters of a ground, in metres.

    The height of the relief is slope_x * x + slope_y * y + wave * sin(2 pi x / wavelength) *
    cos(2 pi y / wavelength), minus the camber.
    """

    slope_x: float = 0.0
    slope_y: float = 0.0
    wave: float = 0.0
    wavelength: float = 25.0
    camber: float = 0.0  # slope down from the centre line to both curbs
    curb_left: float = 1e9  # y of the curbs
    curb_right: float = -1e9
    curb_height: float = 0.0
    walk: float = 1e9  # width of the sidewalk beyond each curb; grass beyond
    crossings: tuple[tuple[float, float], ...] = ()  # x intervals of side streets, without a curb
    parking: float = 0.0  # width of the parking strip inside each curb
    rough: float = 0.0  # maximum height of tufts; ROAD_HEIGHT_SHARE of it on the road
    litter: float = 0.0  # maximum height of bumps on sidewalks and parking strips
    road: float = 0.3  # reflectances
    sidewalk: float = 0.4
    grass: float = 0.35


PAVEMENT = Ground(curb_left=-1e6, curb_right=-1e6 - 1)  # level ground that is all sidewalk


class GroundHit(NamedTuple):
    """Hit of a ray on the ground; without a hit, the range is inf and the rest is 0.

    Attributes:
        range: Metres.
        brightness: Brightness, 0 .. 1.
        cosine: Cosine of the angle of incidence.
        semantic: SemanticKITTI class.
    """

    range: float
    brightness: float
    cosine: float
    semantic: int


@njit(cache=True, nogil=True)
def compute_brightness(reflectance, cosine):
    """Return the brightness of a surface from its reflectance and the cosine of the angle of incidence.

    It depends less on the incidence than Lambert's law: in KITTI, the road has the same intensity
    at 6 m as at 20 m, at grazing incidence. A retroreflector is equally bright from all directions.
    """
    return reflectance * (1 - 0.25 * (1 - cosine) * (reflectance < RETROREFLECTOR))


def to_compiled(ground: Ground) -> Ground:
    """Convert a ground for compiled code: crossings as an array (C, 2), all other values as floats."""
    return Ground._make(
        np.array(value, np.float64).reshape(-1, 2) if name == "crossings" else float(value)
        for name, value in ground._asdict().items()
    )


def surface_height(ground: Ground, x, y) -> np.ndarray:
    """Return the height of the ground at arrays x and y in m, without bumps and tufts."""
    x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    return _heights(to_compiled(ground), x.ravel(), y.ravel()).reshape(x.shape)


@njit(cache=True, nogil=True)
def _heights(ground, x, y):
    height = np.empty(len(x))
    for i in range(len(x)):
        height[i] = _relief(ground, x[i], y[i])[0]
        if _is_raised(ground, x[i], y[i]):
            height[i] += ground.curb_height
    return height


@njit(cache=True, nogil=True, error_model="numpy")
def cast_ground(ground, start, direction, max_range):
    """Intersect a ray that starts above the road with the ground.

    Args:
        ground: Ground from to_compiled.
        start, direction: Origin and direction (x, y, z) of the ray in the world.
        max_range: Largest range, m.

    Returns:
        The GroundHit.
    """
    nothing = GroundHit(np.inf, 0.0, 0.0, 0)
    if not direction[2] - ground.slope_x * direction[0] - ground.slope_y * direction[1] < -1e-3:
        return nothing
    t, edge = _intersect_relief(ground, start, direction, 0.0, 0.0, max_range), 0.0
    if ground.curb_height and not (t <= max_range and _stays_on_road(ground, start, direction, t)):
        t, edge = _intersect_raised(ground, start, direction, t, max_range)
    if not t <= max_range:
        return nothing
    cosine = edge  # replaced if the ray hits a curb
    if not edge:
        _, slope_x, slope_y = _relief(ground, start[0] + t * direction[0], start[1] + t * direction[1])
        cosine = min(max(slope_x * direction[0] + slope_y * direction[1] - direction[2], 1e-3), 1.0)
        if ground.rough or ground.litter:
            t = _intersect_tufts(ground, start, direction, t, cosine)
    semantic, reflectance = _surface(ground, start[0] + t * direction[0], start[1] + t * direction[1])
    if edge:
        semantic, reflectance = SIDEWALK, ground.sidewalk
    return GroundHit(t, compute_brightness(reflectance, cosine), cosine, semantic)


@njit(cache=True, nogil=True, error_model="numpy")
def min_ground_range(ground, start, direction):
    """Return a lower bound of the range at which a ray hits the ground, inf if it does not descend.

    It is much cheaper than cast_ground.
    """
    closing = ground.slope_x * direction[0] + ground.slope_y * direction[1] - direction[2]
    if closing <= 1e-3:
        return np.inf
    height = start[2] - ground.slope_x * start[0] - ground.slope_y * start[1] - abs(ground.wave)
    height -= ground.curb_height + 0.01  # margin for the residual error of Newton's method
    tall = max(ground.rough, ground.litter)
    return max((height - tall) / closing, height / closing - MAX_TUFT_DISTANCE_M)


@njit(cache=True, nogil=True)
def _stays_on_road(ground, start, direction, t):
    """Return True if a ray stays between the curbs up to range t."""
    y, end = start[1], start[1] + t * direction[1]
    return ground.curb_right < min(y, end) and max(y, end) < ground.curb_left


@njit(cache=True, nogil=True)
def _relief(ground, x, y):
    """Return the height of the relief at x, y, and its slopes along x and y."""
    middle, half = (ground.curb_left + ground.curb_right) / 2, (ground.curb_left - ground.curb_right) / 2
    aside = y - middle
    height = ground.slope_x * x + ground.slope_y * y - ground.camber * min(abs(aside), half)
    slope_x, slope_y = ground.slope_x, ground.slope_y
    if abs(aside) < half:
        slope_y -= ground.camber * np.sign(aside)
    if ground.wave:
        turns = 2 * np.pi / ground.wavelength
        a, b = turns * x, turns * y
        sin, cos = math.sin(a), math.cos(b)
        height += ground.wave * sin * cos
        slope_x += ground.wave * turns * math.cos(a) * cos
        slope_y -= ground.wave * turns * sin * math.sin(b)
    return height, slope_x, slope_y


@njit(cache=True, nogil=True)
def _is_in_side_street(ground, x):
    """Return True if x is in a side street."""
    for i in range(len(ground.crossings)):
        if ground.crossings[i, 0] < x < ground.crossings[i, 1]:
            return True
    return False


@njit(cache=True, nogil=True)
def _is_raised(ground, x, y):
    """Return True if x, y is beyond the curbs and not in a side street."""
    return (y <= ground.curb_right or y >= ground.curb_left) and not _is_in_side_street(ground, x)


@njit(cache=True, nogil=True, error_model="numpy")
def _intersect_relief(ground, start, direction, lift, t, max_range):
    """Intersect a ray with the relief raised by lift, by Newton's method from range t; inf without a hit."""
    for _ in range(10):
        height, slope_x, slope_y = _relief(ground, start[0] + t * direction[0], start[1] + t * direction[1])
        gap = start[2] + t * direction[2] - height - lift
        closing = slope_x * direction[0] + slope_y * direction[1] - direction[2]
        t = min(max(t + gap / max(closing, 1e-4), 0.0), 2 * max_range)
        if abs(gap) <= 1e-4:  # the remaining error is far smaller
            return t
    return np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def _intersect_raised(ground, start, direction, low, max_range):
    """Intersect a ray with sidewalks and curbs.

    low: range of the intersection with the relief.

    Returns:
        The range of the first hit, and the cosine of the incidence if it is a curb, else 0.
    """
    high = _intersect_relief(ground, start, direction, ground.curb_height, min(low, max_range), max_range)
    if high < np.inf and _is_raised(ground, start[0] + high * direction[0], start[1] + high * direction[1]):
        return high, 0.0
    t, edge = low, 0.0
    for i in range(2 + 2 * len(ground.crossings)):
        axis, line = 1, ground.curb_left if i == 0 else ground.curb_right
        if i >= 2:
            axis, line = 0, ground.crossings[(i - 2) // 2, i % 2]
        at = (line - start[axis]) / direction[axis]
        if high < at < t:
            beyond = at + 1e-4
            if _is_raised(ground, start[0] + beyond * direction[0], start[1] + beyond * direction[1]):
                t, edge = at, abs(direction[axis])
    return t, edge


@njit(cache=True, nogil=True, error_model="numpy")
def _intersect_tufts(ground, start, direction, t, cosine):
    """Return the range of the first tuft or bump on a ray that hits the ground at range t, else t.

    The last part of the ray is searched in TUFT_STEPS steps. The result is 0 if the ray starts in a
    tuft.
    """
    step = min(max(ground.rough, ground.litter) / cosine, MAX_TUFT_DISTANCE_M) / TUFT_STEPS
    end, begin = start[1] + t * direction[1], start[1] + (t - TUFT_STEPS * step) * direction[1]
    left, right = ground.curb_left - ground.parking, ground.curb_right + ground.parking
    first = TUFT_STEPS - 1
    if max(end, begin) <= left and min(end, begin) >= right:
        first = 0  # bumps on the road are lower
    for k in range(first, -1, -1):
        back = k * step
        if back >= t:
            continue  # behind the sensor
        top = tuft_height(
            ground, start[0] + (t - back) * direction[0], start[1] + (t - back) * direction[1], back * cosine
        )
        above = top / cosine  # the ray has this height at this distance before t
        if above > back:
            return max(t - min(above, back + step), 0.0)
    return t


@njit(cache=True, nogil=True)
def tuft_height(ground, x, y, least):
    """Return the height of tufts and bumps at x, y, which are high in patches.

    The result is 0 if the height is certainly not above `least`, which is faster.
    """
    patch = min(max((_bumps(x / PATCH, y / PATCH) - BARE_SHARE) * PATCH_STEEPNESS, BARE_HEIGHT_SHARE), 1.0)
    if not patch * max(ground.rough, ground.litter) > least:
        return 0.0
    semantic, _ = _surface(ground, x, y)
    most = ground.rough if semantic == ROAD or semantic == GRASS else ground.litter
    return (ROAD_HEIGHT_SHARE if semantic == ROAD else patch) * most * _bumps(x, y)


@njit(cache=True, nogil=True)
def _surface(ground, x, y):
    """Return SemanticKITTI class and reflectance of the ground at x, y."""
    beyond = max(y - ground.curb_left, ground.curb_right - y)
    if _is_in_side_street(ground, x):
        return ROAD, ground.road
    if beyond >= 0:
        return (SIDEWALK, ground.sidewalk) if beyond < ground.walk else (GRASS, ground.grass)
    return ROAD if beyond < -ground.parking else PARKING, ground.road


@njit(cache=True, nogil=True)
def _bumps(x, y):
    """Return smooth noise in 0 .. 1 at x, y, the same at all times."""
    x, y = x / GRAIN_M, y / GRAIN_M
    left, low = math.floor(x), math.floor(y)
    place = (np.int64(left) << 32) + np.int64(low)
    a, b = x - left, y - low
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    far = np.int64(1) << 32
    near = hash_uniform(0, np.uint64(place)) * (1 - b) + hash_uniform(0, np.uint64(place + 1)) * b
    next = hash_uniform(0, np.uint64(place + far)) * (1 - b) + hash_uniform(0, np.uint64(place + far + 1)) * b
    return near * (1 - a) + next * a
