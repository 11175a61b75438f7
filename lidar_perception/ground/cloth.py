"""Ground by cloth simulation (paper C, Eq. 2 and 3; Zhang et al., Remote Sensing 2016, 8, 501).

The cloud is turned over, a cloth falls on it, and what lies on the cloth is ground. Only where the
cloth comes to rest matters, so that is computed directly and not by letting it fall: seen upright,
the cloth is pressed up against the lowest points. At rest each particle either touches the lowest
point of its cell, or hangs free between its neighbours, bent by the load. There is one such state,
whatever the order of the points and of the steps (see obstacle.py).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from lidar_perception.ground.climbing import UNOBSERVED, climbed_cells
from lidar_perception.ground.obstacle import at_rest
from lidar_perception.ground.params import ClothParams

LEVELS = 6         # grids of the solver, each twice as coarse as the one before
TOLERANCE = 0.001  # m that a particle may still move
SQUARES = (2, 6)   # cells around one that are asked whether it is sunk
SUNK = 0.4         # m under its surroundings from which a lone lowest point is a reflection


class Cloth(NamedTuple):
    """height (R, C) float32 of the particles, m; particle (r, c) is at x = x0 + c * resolution,
    y = y0 + r * resolution. lowest (R, C) float32: the lowest point of the cell around each, inf
    where there is none."""

    height: np.ndarray
    x0: float
    y0: float
    resolution: float
    lowest: np.ndarray


def segment_by_cloth(xyz: np.ndarray, params: ClothParams = ClothParams()) -> np.ndarray:
    """(N,) bool, True = ground: points (N, 3) float32, finite, within class_threshold of the
    cloth, vertically (Eq. 3), or of the lowest point of a cell that the ground climbs to. Points
    beyond max_range are not ground."""
    cloth = lay_cloth(xyz, params)
    if cloth is None:
        return np.zeros(len(xyz), bool)
    climbed = np.full(cloth.height.shape, -UNOBSERVED, np.float32)
    if params.slope > 0.0:
        reached = climbed_cells(cloth.lowest, cloth.height, params.class_threshold,
                                params.slope * cloth.resolution)
        climbed[reached] = cloth.lowest[reached]
    return _near_cloth(xyz, cloth.height, climbed, cloth.x0, cloth.y0, 1.0 / cloth.resolution,
                       params.max_range, params.class_threshold)


def lay_cloth(xyz: np.ndarray, params: ClothParams = ClothParams()) -> Cloth | None:
    """The cloth at rest under points (N, 3); None where no point is within max_range."""
    # Cells at whole multiples of the coarsest size: a far point adds cells and moves none.
    block = 2 ** (LEVELS - 1)
    low_x, low_y, high_x, high_y = _bounds(xyz, params.max_range)
    if low_x > high_x:
        return None
    size = params.resolution * block
    first = np.floor([low_x / size, low_y / size])
    columns, rows = ((np.floor([high_x / size, high_y / size]) - first + 1) * block).astype(int)
    x0, y0 = first * size
    lowest = _lowest_points(xyz, params.max_range, x0, y0, 1.0 / params.resolution, rows, columns)
    _drop_sunk(lowest, SUNK)
    lift = params.curvature * params.resolution**2 / 4
    half = params.resolution / 2
    return Cloth(at_rest(lowest, lift, TOLERANCE, LEVELS), float(x0) + half, float(y0) + half,
                 params.resolution, lowest)


@njit(cache=True, nogil=True)
def _bounds(xyz, max_range):
    """[low x, low y, high x, high y] of the points within max_range along x and y."""
    bounds = np.array([np.inf, np.inf, -np.inf, -np.inf])
    for i in range(len(xyz)):
        x, y = np.float64(xyz[i, 0]), np.float64(xyz[i, 1])
        if abs(x) <= max_range and abs(y) <= max_range:
            bounds[0], bounds[2] = min(bounds[0], x), max(bounds[2], x)
            bounds[1], bounds[3] = min(bounds[1], y), max(bounds[3], y)
    return bounds


@njit(cache=True, nogil=True)
def _lowest_points(xyz, max_range, x0, y0, scale, rows, columns):
    """(rows, columns) z of the lowest point in each cell, UNOBSERVED where there is none."""
    lowest = np.full((rows, columns), UNOBSERVED, np.float32)
    for i in range(len(xyz)):
        x, y = np.float64(xyz[i, 0]), np.float64(xyz[i, 1])
        if abs(x) <= max_range and abs(y) <= max_range:
            r = min(max(int((y - y0) * scale), 0), rows - 1)
            c = min(max(int((x - x0) * scale), 0), columns - 1)
            lowest[r, c] = min(lowest[r, c], xyz[i, 2])
    return lowest


@njit(cache=True, nogil=True)
def _drop_sunk(lowest, depth):
    """Make cells UNOBSERVED whose lowest point lies deeper than those of the cells around, all but
    one: reflections under the ground would pull the cloth down for metres around. Far away few
    cells near have a point, so that the wider square is asked."""
    rows, columns = lowest.shape
    sunk = []
    for r in range(rows):
        for c in range(columns):
            if lowest[r, c] == UNOBSERVED:
                continue
            for reach in SQUARES:
                higher = level = 0
                for i in range(max(r - reach, 0), min(r + reach + 1, rows)):
                    for j in range(max(c - reach, 0), min(c + reach + 1, columns)):
                        if lowest[i, j] != UNOBSERVED:
                            if lowest[i, j] > lowest[r, c] + depth:
                                higher += 1
                            else:
                                level += 1
                    if level > 2:
                        break
                if level > 2:
                    break
                if higher >= 4:  # the cell itself and one more are not
                    sunk.append((r, c))
                    break
    for r, c in sunk:
        lowest[r, c] = UNOBSERVED


@njit(cache=True, nogil=True)
def _near_cloth(xyz, height, climbed, x0, y0, scale, max_range, threshold):
    """(N,) bool: within max_range, and within threshold of the cloth, interpolated bilinearly, or
    no more than that above climbed (R, C)."""
    rows, columns = height.shape
    near = np.zeros(len(xyz), np.bool_)
    for i in range(len(xyz)):
        x, y = np.float64(xyz[i, 0]), np.float64(xyz[i, 1])
        if abs(x) <= max_range and abs(y) <= max_range:
            u = min(max((x - x0) * scale, 0.0), columns - 1.0)
            v = min(max((y - y0) * scale, 0.0), rows - 1.0)
            c, r = min(int(u), columns - 2), min(int(v), rows - 2)
            a, b = u - c, v - r
            cloth = ((1 - b) * ((1 - a) * height[r, c] + a * height[r, c + 1])
                     + b * ((1 - a) * height[r + 1, c] + a * height[r + 1, c + 1]))
            near[i] = (abs(xyz[i, 2] - cloth) <= threshold
                       or xyz[i, 2] - climbed[int(v + 0.5), int(u + 0.5)] <= threshold)
    return near
