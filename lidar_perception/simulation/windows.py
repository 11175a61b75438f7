"""Windows of the grid of firings and beams that contain all rays that can hit a solid."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from lidar_perception.simulation.sensor import NO_MOTION, Motion, Sensor
from lidar_perception.simulation.solids import BOX, ELLIPSOID, Solids


class Windows(NamedTuple):
    """Windows of P solids; no ray outside hits the solid.

    Attributes:
        first: (P,) int64 first column, 0 .. columns - 1.
        count: (P,) int64 number of columns, which may continue past the last one at 0.
        beams: (P, rings) bool.
        near: (P,) m; no hit is nearer.
    """

    first: np.ndarray
    count: np.ndarray  # type: ignore[assignment]  # a tuple has a count of its own
    beams: np.ndarray
    near: np.ndarray


class Grid(NamedTuple):
    """Properties of the sensor and its motion that the windows of all solids need.

    rise and fall: (rings,) slopes of a beam's highest and lowest rays; lift: (rings,) m; wide:
    margin in azimuth, rad; begin and end of the turn: seconds after the stamp; moves: anything
    moves.
    """

    columns: int
    rate: float
    stamp: float
    yaw_rate: float
    begin: float
    end: float
    wide: float
    max_range: float
    moves: bool
    lift: np.ndarray
    rise: np.ndarray
    fall: np.ndarray


def find_windows(solids: Solids, sensor: Sensor, motion: Motion = NO_MOTION, margin: float = 0.0) -> Windows:
    """Find the windows of solids in the sensor's frame at the stamp.

    Args:
        solids: The solids.
        sensor: The sensor; its beams may start at different heights.
        motion: Motion of the sensor.
        margin: Largest deviation of rays from the sensor's, rad.
    """
    relative = solids.velocity - np.asarray(motion.velocity, np.float64)
    since = sensor.times() - motion.stamp / sensor.rate
    elevations, limit = np.asarray(sensor.elevations), np.pi / 2 - 1e-6
    rise, fall = (np.tan(np.clip(elevations + m, -limit, limit)) for m in (margin + 1e-9, -margin - 1e-9))
    grid = Grid(
        sensor.columns,
        float(sensor.rate),
        float(motion.stamp),
        float(motion.yaw_rate),
        float(since.min()),
        float(since.max()),
        float(margin / np.cos(np.abs(elevations).max())),
        float(sensor.max_range),
        bool(relative.any() or motion.yaw_rate),
        sensor.origins()[:, 2].copy(),
        rise,
        fall,
    )
    count = len(solids)
    found = Windows(
        np.empty(count, np.int64), np.empty(count, np.int64), np.empty((count, sensor.rings), bool), np.empty(count)
    )
    shapes = (np.array(part, float, order="C") for part in (solids.centre, solids.half, solids.axes, relative))
    _fill_windows(found, grid, np.array(solids.kind), *shapes)
    return found


@njit(cache=True, nogil=True)
def _fill_windows(found, grid, kind, centre, half, axes, relative):
    corners, facing, reach = np.empty((16, 3)), np.empty((3, 3)), np.empty(3)
    for p in range(len(kind)):
        # The time of the full revolution gives a window, which gives the time when the sensor faces it.
        begin, end = (grid.begin, grid.end) if grid.moves else (0.0, 0.0)
        for _ in range(3 if grid.moves else 1):
            ahead = _find_direction(centre[p], relative[p], (begin + end) / 2)
            _fill_corners(corners, facing, reach, kind[p], centre[p], half[p], axes[p], relative[p], ahead, begin, end)
            first, count = _find_columns(corners, grid, begin, end)
            latest = grid.columns // 2 - first
            earliest = latest - count + 1
            begin, end = grid.begin, grid.end
            if latest // grid.columns == earliest // grid.columns:
                turn = grid.columns * grid.rate
                begin = earliest % grid.columns / turn - grid.stamp / grid.rate
                end = latest % grid.columns / turn - grid.stamp / grid.rate
        found.first[p], found.count[p] = first % grid.columns, count
        found.near[p] = _fill_beams(corners, facing, ahead, grid, found.beams[p]) - 1e-6


@njit(cache=True, nogil=True)
def _find_direction(centre, relative, since):
    """Return the horizontal direction to a solid."""
    x, y = centre[0] + relative[0] * since, centre[1] + relative[1] * since
    far = max(math.hypot(x, y), 1e-9)
    return x / far, y / far


@njit(cache=True, nogil=True)
def _fill_corners(corners, facing, reach, kind, centre, half, axes, relative, ahead, begin, end):
    """Fill the corners (16, 3) of a box around a solid from begin to end (s), and its axes.

    Round solids get a box that faces the sensor, which is tighter.
    """
    if kind == BOX:
        facing[:] = axes
        reach[:] = half
    else:
        facing[:] = 0.0
        facing[0, 0], facing[1, 0] = ahead
        facing[0, 1], facing[1, 1] = -ahead[1], ahead[0]
        facing[2, 2] = 1.0
        for i in range(3):
            a, b, c = 0.0, 0.0, 0.0
            for j in range(3):
                a += facing[j, i] * axes[j, 0] * half[0]
                b += facing[j, i] * axes[j, 1] * half[1]
                c += facing[j, i] * axes[j, 2] * half[2]
            reach[i] = math.sqrt(a * a + b * b + (c * c)) if kind == ELLIPSOID else (math.sqrt(a * a + b * b) + abs(c))
    for n in range(16):
        since = begin if n < 8 else end
        for i in range(3):
            corners[n, i] = centre[i] + relative[i] * since
            for j in range(3):
                corners[n, i] += facing[i, j] * (reach[j] if n >> j & 1 else -reach[j])


@njit(cache=True, nogil=True)
def _find_columns(corners, grid, begin, end):
    """Return the first column and the number of columns; the sensor turns meanwhile."""
    x, y = 0.0, 0.0
    for n in range(16):
        x, y = x + corners[n, 0], y + corners[n, 1]
    middle, low, high = math.atan2(y, x), np.inf, -np.inf
    for n in range(16):
        bearing = math.atan2(corners[n, 1], corners[n, 0]) - middle
        bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
        low, high = min(low, bearing), max(high, bearing)
    around = high - low >= np.pi  # the sensor is above or below the box
    turned = grid.yaw_rate * begin, grid.yaw_rate * end
    low, high = low - max(turned) - grid.wide, high - min(turned) + grid.wide
    step = 2 * np.pi / grid.columns
    first = math.floor((middle + low) / step)
    count = math.ceil((middle + high) / step) - first + 1
    if around or count >= grid.columns:
        return 0, grid.columns
    return first, count


@njit(cache=True, nogil=True)
def _fill_beams(corners, facing, ahead, grid, beams):
    """Fill which beams (rings,) reach the height of the box; return its distance from the z axis."""
    near, far, bottom, top = 0.0, 0.0, np.inf, -np.inf
    for side in range(3):  # horizontal directions: two sides of the box, and towards it
        x, y = ahead if side == 2 else (facing[0, side], facing[1, side])
        long = max(math.hypot(x, y), 1e-9)
        least, most = np.inf, -np.inf
        for n in range(16):
            along = (x * corners[n, 0] + y * corners[n, 1]) / long
            least, most = min(least, along), max(most, along)
        near = max(near, least, -most)
    for n in range(16):
        far = max(far, math.hypot(corners[n, 0], corners[n, 1]))
        bottom, top = min(bottom, corners[n, 2]), max(top, corners[n, 2])
    for r in range(len(beams)):
        highest = grid.lift[r] + max(near * grid.rise[r], far * grid.rise[r])
        lowest = grid.lift[r] + min(near * grid.fall[r], far * grid.fall[r])
        beams[r] = highest >= bottom and lowest <= top and near <= grid.max_range
    return near
