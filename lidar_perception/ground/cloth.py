"""Ground segmentation by cloth simulation (paper C, Eq. 2 and 3; Zhang et al., Remote Sensing 2016, 8, 501).

In the paper, a cloth falls onto the inverted cloud, and the points near the cloth are ground. Only
the final position of the cloth matters, so it is computed directly instead of simulating the fall.
In the upright cloud, this is a cloth pressed against the lowest points from below: each particle
either touches the lowest point of its cell or is held by its neighbours, bent by the load. This
state is unique and does not depend on the order of points or steps (see cloth_solver.py).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from lidar_perception.ground.cloth_slopes import UNOBSERVED, find_climbing_cells
from lidar_perception.ground.cloth_solver import settle_sheet
from lidar_perception.ground.params import ClothParams

GRID_LEVELS = 6  # number of grids of the solver, each twice as coarse as the previous one
TOLERANCE_M = 0.001  # maximum movement of a particle in the last step
REFLECTION_WINDOWS = (2, 6)  # half widths, in cells, of the windows in which a cell is compared with its neighbours
REFLECTION_DEPTH_M = 0.4  # minimum depth of a reflection below its surroundings


class Cloth(NamedTuple):
    """Cloth at rest.

    Particle (r, c) is at x = x0 + c * resolution, y = y0 + r * resolution.

    Attributes:
        height: (R, C) float32 height of each particle, in metres.
        x0, y0: x of the first column and y of the first row, in metres.
        resolution: distance between neighbouring particles, in metres.
        lowest: (R, C) float32 height of the lowest point in the cell around each particle, inf for
            cells without points.
    """

    height: np.ndarray
    x0: float
    y0: float
    resolution: float
    lowest: np.ndarray


def segment_by_cloth(xyz: np.ndarray, params: ClothParams = ClothParams()) -> np.ndarray:
    """Segment the ground of finite points (N, 3) float32.

    Returns:
        (N,) bool, True = ground: points within class_threshold of the cloth along z (Eq. 3), or of
        the lowest point of a cell that continues the ground uphill. Points beyond max_range are not
        ground.
    """
    cloth = lay_cloth(xyz, params)
    if cloth is None:
        return np.zeros(len(xyz), bool)
    climbing_height = np.full(cloth.height.shape, -UNOBSERVED, np.float32)
    if params.slope > 0.0:
        is_climbing = find_climbing_cells(
            cloth.lowest, cloth.height, params.class_threshold, params.slope * cloth.resolution
        )
        climbing_height[is_climbing] = cloth.lowest[is_climbing]
    return _select_near_cloth(
        xyz,
        cloth.height,
        climbing_height,
        cloth.x0,
        cloth.y0,
        1.0 / cloth.resolution,
        params.max_range,
        params.class_threshold,
    )


def lay_cloth(xyz: np.ndarray, params: ClothParams = ClothParams()) -> Cloth | None:
    """Compute the cloth at rest under points (N, 3); return None if no point is within max_range."""
    # Cells start at multiples of the coarsest size, so that a distant point adds cells but moves none.
    block = 2 ** (GRID_LEVELS - 1)
    low_x, low_y, high_x, high_y = _find_bounds(xyz, params.max_range)
    if low_x > high_x:
        return None
    block_size = params.resolution * block
    first_block = np.floor([low_x / block_size, low_y / block_size])
    columns, rows = ((np.floor([high_x / block_size, high_y / block_size]) - first_block + 1) * block).astype(int)
    x0, y0 = first_block * block_size
    lowest = _find_lowest_points(xyz, params.max_range, x0, y0, 1.0 / params.resolution, rows, columns)
    _drop_reflections(lowest, REFLECTION_DEPTH_M)
    lift = params.curvature * params.resolution**2 / 4
    half_cell = params.resolution / 2
    height = settle_sheet(lowest, lift, TOLERANCE_M, GRID_LEVELS)
    return Cloth(height, float(x0) + half_cell, float(y0) + half_cell, params.resolution, lowest)


@njit(cache=True, nogil=True)
def _find_bounds(xyz, max_range):
    """Return [low x, low y, high x, high y] of the points within max_range along x and y."""
    bounds = np.array([np.inf, np.inf, -np.inf, -np.inf])
    for i in range(len(xyz)):
        x, y = np.float64(xyz[i, 0]), np.float64(xyz[i, 1])
        if abs(x) <= max_range and abs(y) <= max_range:
            bounds[0], bounds[2] = min(bounds[0], x), max(bounds[2], x)
            bounds[1], bounds[3] = min(bounds[1], y), max(bounds[3], y)
    return bounds


@njit(cache=True, nogil=True)
def _find_lowest_points(xyz, max_range, x0, y0, scale, rows, columns):
    """Return the height (rows, columns) of the lowest point in each cell, UNOBSERVED without points."""
    lowest = np.full((rows, columns), UNOBSERVED, np.float32)
    for i in range(len(xyz)):
        x, y = np.float64(xyz[i, 0]), np.float64(xyz[i, 1])
        if abs(x) <= max_range and abs(y) <= max_range:
            r = min(max(int((y - y0) * scale), 0), rows - 1)
            c = min(max(int((x - x0) * scale), 0), columns - 1)
            lowest[r, c] = min(lowest[r, c], xyz[i, 2])
    return lowest


@njit(cache=True, nogil=True)
def _drop_reflections(lowest, depth):
    """Mark cells with reflections below the ground as UNOBSERVED.

    A cell is dropped if its lowest point is more than `depth` metres below the lowest points of all
    neighbouring cells except at most one. Such a point would pull the cloth down for metres around
    it. The wider window is for large ranges, where few neighbouring cells have points.
    """
    rows, columns = lowest.shape
    reflections = []
    for r in range(rows):
        for c in range(columns):
            if lowest[r, c] == UNOBSERVED:
                continue
            for reach in REFLECTION_WINDOWS:
                higher_count = level_count = 0
                for i in range(max(r - reach, 0), min(r + reach + 1, rows)):
                    for j in range(max(c - reach, 0), min(c + reach + 1, columns)):
                        if lowest[i, j] != UNOBSERVED:
                            if lowest[i, j] > lowest[r, c] + depth:
                                higher_count += 1
                            else:
                                level_count += 1
                    if level_count > 2:
                        break
                if level_count > 2:
                    break
                if higher_count >= 4:  # all neighbours except at most one
                    reflections.append((r, c))
                    break
    for r, c in reflections:
        lowest[r, c] = UNOBSERVED


@njit(cache=True, nogil=True)
def _select_near_cloth(xyz, height, climbing_height, x0, y0, scale, max_range, threshold):
    """Select the points within max_range that are close to the cloth or to ground that climbs, (N,) bool.

    The height (R, C) of the cloth is interpolated bilinearly. climbing_height (R, C) is the height
    of the lowest point of cells that continue the ground uphill, -inf for other cells. `threshold`
    is the maximum distance from the cloth along z and the maximum height above climbing_height.
    """
    rows, columns = height.shape
    is_ground = np.zeros(len(xyz), np.bool_)
    for i in range(len(xyz)):
        x, y = np.float64(xyz[i, 0]), np.float64(xyz[i, 1])
        if abs(x) <= max_range and abs(y) <= max_range:
            u = min(max((x - x0) * scale, 0.0), columns - 1.0)
            v = min(max((y - y0) * scale, 0.0), rows - 1.0)
            c, r = min(int(u), columns - 2), min(int(v), rows - 2)
            a, b = u - c, v - r
            cloth_height = (1 - b) * ((1 - a) * height[r, c] + a * height[r, c + 1]) + b * (
                (1 - a) * height[r + 1, c] + a * height[r + 1, c + 1]
            )
            is_ground[i] = (
                abs(xyz[i, 2] - cloth_height) <= threshold
                or xyz[i, 2] - climbing_height[int(v + 0.5), int(u + 0.5)] <= threshold
            )
    return is_ground
