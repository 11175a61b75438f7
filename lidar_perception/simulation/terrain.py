"""Ground: a sloping road with waves and camber, side streets, sidewalks and grass.

The ground is a smooth relief in the world frame (x along the street, y left, z up, metres). Beyond
the curbs, it is raised by the curb height. A ray is intersected with the raised relief first. If that
point is on the road, the ray continues to the road or a curb. Bumps, tufts of grass and litter may
stop the ray earlier.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from lidar_perception.simulation.hashing import hash_uniform
from lidar_perception.simulation.solids import RETROREFLECTOR

ROAD, PARKING, SIDEWALK, GRASS = 40, 44, 48, 72  # SemanticKITTI classes
BUMP_SPACING_M = 0.25  # distance between the bumps of a rough surface
PATCH_SPACING = 10  # distance between rough patches, in bumps
BARE_FRACTION = 0.45  # approximate fraction of the ground between the patches
PATCH_STEEPNESS = 3.0  # slope of the edges of patches
BARE_HEIGHT_RATIO = 0.1  # height of bumps between patches, relative to bumps in patches
ROAD_HEIGHT_RATIO = 0.06  # height of bumps on the road, relative to bumps in patches
MAX_TUFT_DISTANCE_M, TUFT_STEPS = 6.0, 8  # length of the end of a ray that is searched for tufts, and search steps


class Ground(NamedTuple):
    """Parameters of the ground, in metres.

    The height of the relief is slope_x * x + slope_y * y + wave_height * sin(2 pi x / wavelength) *
    cos(2 pi y / wavelength), minus the camber.
    """

    slope_x: float = 0.0
    slope_y: float = 0.0
    wave_height: float = 0.0
    wavelength: float = 25.0
    camber: float = 0.0  # slope down from the centre line to both curbs
    curb_left: float = 1e9  # y of the curbs
    curb_right: float = -1e9
    curb_height: float = 0.0
    sidewalk_width: float = 1e9  # width of the sidewalk beyond each curb; the rest is grass
    crossings: tuple[tuple[float, float], ...] = ()  # x intervals of side streets, without a curb
    parking_width: float = 0.0  # width of the parking strip inside each curb
    tuft_height: float = 0.0  # maximum height of tufts; bumps on the road are lower by ROAD_HEIGHT_RATIO
    litter_height: float = 0.0  # maximum height of bumps on sidewalks and parking strips
    road_reflectance: float = 0.3
    sidewalk_reflectance: float = 0.4
    grass_reflectance: float = 0.35


PAVEMENT = Ground(curb_left=-1e6, curb_right=-1e6 - 1)  # level, with sidewalk everywhere


class GroundHit(NamedTuple):
    """Hit of a ray on the ground. Without a hit, the range is inf and all other values are 0.

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

    It depends less on the angle than Lambert's law: in KITTI, the intensity of the road is the same
    at 6 m as at 20 m, where the incidence is grazing. A retroreflector is equally bright from all
    directions.
    """
    return reflectance * (1 - 0.25 * (1 - cosine) * (reflectance < RETROREFLECTOR))


def compile_ground(ground: Ground) -> Ground:
    """Convert a ground for compiled code: crossings as an array (C, 2), all other values as floats."""
    return Ground._make(
        np.array(value, np.float64).reshape(-1, 2) if name == "crossings" else float(value)
        for name, value in ground._asdict().items()
    )


def compute_ground_height(ground: Ground, x, y) -> np.ndarray:
    """Return the height of the ground at arrays x and y in m, without bumps and tufts."""
    x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    return _compute_heights(compile_ground(ground), x.ravel(), y.ravel()).reshape(x.shape)


@njit(cache=True, nogil=True)
def _compute_heights(ground, x, y):
    height = np.empty(len(x))
    for i in range(len(x)):
        height[i] = _evaluate_relief(ground, x[i], y[i])[0]
        if _is_raised(ground, x[i], y[i]):
            height[i] += ground.curb_height
    return height


@njit(cache=True, nogil=True, error_model="numpy")
def cast_ground(ground, start, direction, max_range):
    """Intersect a ray that starts above the road with a ground from compile_ground.

    Args:
        start, direction: Origin and direction (x, y, z) of the ray in the world.
        max_range: Maximum range, m.
    """
    no_hit = GroundHit(np.inf, 0.0, 0.0, 0)
    if not direction[2] - ground.slope_x * direction[0] - ground.slope_y * direction[1] < -1e-3:
        return no_hit
    t, curb_cosine = _intersect_relief(ground, start, direction, 0.0, 0.0, max_range), 0.0
    if ground.curb_height and not (t <= max_range and _stays_on_road(ground, start, direction, t)):
        t, curb_cosine = _intersect_sidewalks_and_curbs(ground, start, direction, t, max_range)
    if not t <= max_range:
        return no_hit
    cosine = curb_cosine
    if not curb_cosine:  # the ray does not hit a curb
        _, slope_x, slope_y = _evaluate_relief(ground, start[0] + t * direction[0], start[1] + t * direction[1])
        cosine = min(max(slope_x * direction[0] + slope_y * direction[1] - direction[2], 1e-3), 1.0)
        if ground.tuft_height or ground.litter_height:
            t = _intersect_tufts(ground, start, direction, t, cosine)
    semantic, reflectance = _classify_surface(ground, start[0] + t * direction[0], start[1] + t * direction[1])
    if curb_cosine:
        semantic, reflectance = SIDEWALK, ground.sidewalk_reflectance
    return GroundHit(t, compute_brightness(reflectance, cosine), cosine, semantic)


@njit(cache=True, nogil=True, error_model="numpy")
def bound_ground_range(ground, start, direction):
    """Return a lower bound of the range at which a ray hits the ground, inf if it does not descend.

    This is much faster than cast_ground.
    """
    closing = ground.slope_x * direction[0] + ground.slope_y * direction[1] - direction[2]
    if closing <= 1e-3:
        return np.inf
    height = start[2] - ground.slope_x * start[0] - ground.slope_y * start[1] - abs(ground.wave_height)
    height -= ground.curb_height + 0.01  # margin for the residual error of Newton's method
    max_bump = max(ground.tuft_height, ground.litter_height)
    return max((height - max_bump) / closing, height / closing - MAX_TUFT_DISTANCE_M)


@njit(cache=True, nogil=True)
def _stays_on_road(ground, start, direction, t):
    """Return True if a ray stays between the curbs up to range t."""
    y, end = start[1], start[1] + t * direction[1]
    return ground.curb_right < min(y, end) and max(y, end) < ground.curb_left


@njit(cache=True, nogil=True)
def _evaluate_relief(ground, x, y):
    """Return the height of the relief at x, y, and its slopes along x and y."""
    centre_y, half_width = (ground.curb_left + ground.curb_right) / 2, (ground.curb_left - ground.curb_right) / 2
    offset = y - centre_y
    height = ground.slope_x * x + ground.slope_y * y - ground.camber * min(abs(offset), half_width)
    slope_x, slope_y = ground.slope_x, ground.slope_y
    if abs(offset) < half_width:
        slope_y -= ground.camber * np.sign(offset)
    if ground.wave_height:
        wavenumber = 2 * np.pi / ground.wavelength
        a, b = wavenumber * x, wavenumber * y
        sin, cos = math.sin(a), math.cos(b)
        height += ground.wave_height * sin * cos
        slope_x += ground.wave_height * wavenumber * math.cos(a) * cos
        slope_y -= ground.wave_height * wavenumber * sin * math.sin(b)
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
    """Intersect a ray with the relief raised by `lift`, by Newton's method from range t.

    Returns:
        The range in m, inf without a hit.
    """
    for _ in range(10):
        height, slope_x, slope_y = _evaluate_relief(ground, start[0] + t * direction[0], start[1] + t * direction[1])
        gap = start[2] + t * direction[2] - height - lift
        closing = slope_x * direction[0] + slope_y * direction[1] - direction[2]
        t = min(max(t + gap / max(closing, 1e-4), 0.0), 2 * max_range)
        if abs(gap) <= 1e-4:  # Newton converges quadratically, so that the error is far smaller
            return t
    return np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def _intersect_sidewalks_and_curbs(ground, start, direction, road_range, max_range):
    """Intersect a ray with sidewalks and curbs.

    Args:
        start, direction: Origin and direction (x, y, z) of the ray in the world.
        road_range: Range at which the ray hits the relief without curbs, m.
        max_range: Maximum range, m.

    Returns:
        The range of the first hit, and the cosine of the angle of incidence on a curb, 0 for other
        hits.
    """
    raised_range = _intersect_relief(
        ground, start, direction, ground.curb_height, min(road_range, max_range), max_range
    )
    if raised_range < np.inf and _is_raised(
        ground, start[0] + raised_range * direction[0], start[1] + raised_range * direction[1]
    ):
        return raised_range, 0.0
    t, curb_cosine = road_range, 0.0
    for i in range(2 + 2 * len(ground.crossings)):
        axis, line = 1, ground.curb_left if i == 0 else ground.curb_right
        if i >= 2:
            axis, line = 0, ground.crossings[(i - 2) // 2, i % 2]
        curb_range = (line - start[axis]) / direction[axis]
        if raised_range < curb_range < t:
            range_behind = curb_range + 1e-4
            if _is_raised(ground, start[0] + range_behind * direction[0], start[1] + range_behind * direction[1]):
                t, curb_cosine = curb_range, abs(direction[axis])
    return t, curb_cosine


@njit(cache=True, nogil=True, error_model="numpy")
def _intersect_tufts(ground, start, direction, t, cosine):
    """Return the range at which a tuft or bump stops a ray that hits the ground at range t.

    Only the last MAX_TUFT_DISTANCE_M of the ray are searched. The result is t if no tuft is hit, and
    0 if the ray starts in a tuft.
    """
    step = min(max(ground.tuft_height, ground.litter_height) / cosine, MAX_TUFT_DISTANCE_M) / TUFT_STEPS
    end, begin = start[1] + t * direction[1], start[1] + (t - TUFT_STEPS * step) * direction[1]
    left, right = ground.curb_left - ground.parking_width, ground.curb_right + ground.parking_width
    first = TUFT_STEPS - 1
    if max(end, begin) <= left and min(end, begin) >= right:
        first = 0  # bumps on the road are lower
    for k in range(first, -1, -1):
        distance = k * step
        if distance >= t:
            continue  # behind the sensor
        top = compute_tuft_height(
            ground,
            start[0] + (t - distance) * direction[0],
            start[1] + (t - distance) * direction[1],
            distance * cosine,
        )
        stop_distance = top / cosine  # distance before t at which the ray is as high as the tuft
        if stop_distance > distance:
            return max(t - min(stop_distance, distance + step), 0.0)
    return t


@njit(cache=True, nogil=True)
def compute_tuft_height(ground, x, y, min_height):
    """Return the height of tufts and bumps at x, y, or 0 if it is below min_height (to save time)."""
    height_ratio = min(
        max(
            (_evaluate_noise(x / PATCH_SPACING, y / PATCH_SPACING) - BARE_FRACTION) * PATCH_STEEPNESS, BARE_HEIGHT_RATIO
        ),
        1.0,
    )
    if not height_ratio * max(ground.tuft_height, ground.litter_height) > min_height:
        return 0.0
    semantic, _ = _classify_surface(ground, x, y)
    max_height = ground.tuft_height if semantic == ROAD or semantic == GRASS else ground.litter_height
    return (ROAD_HEIGHT_RATIO if semantic == ROAD else height_ratio) * max_height * _evaluate_noise(x, y)


@njit(cache=True, nogil=True)
def _classify_surface(ground, x, y):
    """Return the SemanticKITTI class and the reflectance of the ground at x, y."""
    distance = max(y - ground.curb_left, ground.curb_right - y)
    if _is_in_side_street(ground, x):
        return ROAD, ground.road_reflectance
    if distance >= 0:
        return (
            (SIDEWALK, ground.sidewalk_reflectance)
            if distance < ground.sidewalk_width
            else (GRASS, ground.grass_reflectance)
        )
    return ROAD if distance < -ground.parking_width else PARKING, ground.road_reflectance


@njit(cache=True, nogil=True)
def _evaluate_noise(x, y):
    """Return smooth, fixed noise between 0 and 1 at x, y."""
    x, y = x / BUMP_SPACING_M, y / BUMP_SPACING_M
    left, low = math.floor(x), math.floor(y)
    key = (np.int64(left) << 32) + np.int64(low)
    a, b = x - left, y - low
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    right_key = key + (np.int64(1) << 32)
    left_value = hash_uniform(0, np.uint64(key)) * (1 - b) + hash_uniform(0, np.uint64(key + 1)) * b
    right_value = hash_uniform(0, np.uint64(right_key)) * (1 - b) + hash_uniform(0, np.uint64(right_key + 1)) * b
    return left_value * (1 - a) + right_value * a
