"""Windows of solids in the grid of firings and beams, like bounding rectangles in an image."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from lidar_perception.simulation.sensor import NO_MOTION, Motion, Sensor
from lidar_perception.simulation.solids import BOX, ELLIPSOID, Solids


class Windows(NamedTuple):
    """Windows of P solids. Only rays in the window of a solid can hit it.

    Attributes:
        first: (P,) int64 first column, 0 .. columns - 1.
        count: (P,) int64 number of columns; after the last column of the grid follows column 0.
        beams: (P, rings) bool, beams that can hit the solid.
        min_range: (P,) lower bound of the range of a hit, m.
    """

    first: np.ndarray
    count: np.ndarray  # type: ignore[assignment]  # overrides tuple.count
    beams: np.ndarray
    min_range: np.ndarray


class Grid(NamedTuple):
    """Grid of rays, and the motion of the sensor.

    Attributes:
        columns, rate, max_range: See Sensor.
        stamp, yaw_rate: See Motion.
        begin, end: Begin and end of the turn, seconds after the stamp.
        margin: Margin in azimuth, rad.
        moves: The sensor or a solid moves.
        lift: (rings,) start of each beam on the z axis, m.
        rise, fall: (rings,) slopes of the highest and the lowest ray of each beam.
    """

    columns: int
    rate: float
    stamp: float
    yaw_rate: float
    begin: float
    end: float
    margin: float
    max_range: float
    moves: bool
    lift: np.ndarray
    rise: np.ndarray
    fall: np.ndarray


def find_windows(solids: Solids, sensor: Sensor, motion: Motion = NO_MOTION, margin: float = 0.0) -> Windows:
    """Find the windows of solids.

    Args:
        solids: Solids in the sensor's frame at the stamp.
        sensor: The sensor.
        motion: Motion of the sensor.
        margin: Largest angle between a ray and its beam, rad.
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
    windows = Windows(
        np.empty(count, np.int64), np.empty(count, np.int64), np.empty((count, sensor.rings), bool), np.empty(count)
    )
    arrays = (np.array(values, float, order="C") for values in (solids.centre, solids.half, solids.axes, relative))
    _fill_windows(windows, grid, np.array(solids.kind), *arrays)
    return windows


@njit(cache=True, nogil=True)
def _fill_windows(windows, grid, kind, centre, half, axes, relative):
    corners, box_axes, box_half = np.empty((16, 3)), np.empty((3, 3)), np.empty(3)
    for p in range(len(kind)):
        # Iterate: the window for the whole turn limits the time at which the sensor faces the solid.
        begin, end = (grid.begin, grid.end) if grid.moves else (0.0, 0.0)
        for _ in range(3 if grid.moves else 1):
            ahead = _find_direction(centre[p], relative[p], (begin + end) / 2)
            _fill_corners(
                corners, box_axes, box_half, kind[p], centre[p], half[p], axes[p], relative[p], ahead, begin, end
            )
            first, count = _find_columns(corners, grid, begin, end)
            latest = grid.columns // 2 - first
            earliest = latest - count + 1
            begin, end = grid.begin, grid.end
            if latest // grid.columns == earliest // grid.columns:
                turn = grid.columns * grid.rate
                begin = earliest % grid.columns / turn - grid.stamp / grid.rate
                end = latest % grid.columns / turn - grid.stamp / grid.rate
        windows.first[p], windows.count[p] = first % grid.columns, count
        windows.min_range[p] = _fill_beams(corners, box_axes, ahead, grid, windows.beams[p]) - 1e-6


@njit(cache=True, nogil=True)
def _find_direction(centre, relative, since):
    """Return the horizontal direction (x, y) to a solid at a time."""
    x, y = centre[0] + relative[0] * since, centre[1] + relative[1] * since
    distance = max(math.hypot(x, y), 1e-9)
    return x / distance, y / distance


@njit(cache=True, nogil=True)
def _fill_corners(corners, box_axes, box_half, kind, centre, half, axes, relative, ahead, begin, end):
    """Fill the corners (16, 3) of a box around a solid at begin and end (s), its axes and its half sizes.

    Round solids get a box that faces the sensor, which is tighter.
    """
    if kind == BOX:
        box_axes[:] = axes
        box_half[:] = half
    else:
        box_axes[:] = 0.0
        box_axes[0, 0], box_axes[1, 0] = ahead
        box_axes[0, 1], box_axes[1, 1] = -ahead[1], ahead[0]
        box_axes[2, 2] = 1.0
        for i in range(3):
            a, b, c = 0.0, 0.0, 0.0
            for j in range(3):
                a += box_axes[j, i] * axes[j, 0] * half[0]
                b += box_axes[j, i] * axes[j, 1] * half[1]
                c += box_axes[j, i] * axes[j, 2] * half[2]
            if kind == ELLIPSOID:
                box_half[i] = math.sqrt(a * a + b * b + (c * c))
            else:
                box_half[i] = math.sqrt(a * a + b * b) + abs(c)
    for n in range(16):
        since = begin if n < 8 else end
        for i in range(3):
            corners[n, i] = centre[i] + relative[i] * since
            for j in range(3):
                corners[n, i] += box_axes[i, j] * (box_half[j] if n >> j & 1 else -box_half[j])


@njit(cache=True, nogil=True)
def _find_columns(corners, grid, begin, end):
    """Return the first column and the number of columns of a window, with the rotation of the sensor."""
    x, y = 0.0, 0.0
    for n in range(16):
        x, y = x + corners[n, 0], y + corners[n, 1]
    middle, low, high = math.atan2(y, x), np.inf, -np.inf
    for n in range(16):
        bearing = math.atan2(corners[n, 1], corners[n, 0]) - middle
        bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
        low, high = min(low, bearing), max(high, bearing)
    is_overhead = high - low >= np.pi  # the sensor is above or below the box
    yaws = grid.yaw_rate * begin, grid.yaw_rate * end
    low, high = low - max(yaws) - grid.margin, high - min(yaws) + grid.margin
    step = 2 * np.pi / grid.columns
    first = math.floor((middle + low) / step)
    count = math.ceil((middle + high) / step) - first + 1
    if is_overhead or count >= grid.columns:
        return 0, grid.columns
    return first, count


@njit(cache=True, nogil=True)
def _fill_beams(corners, box_axes, ahead, grid, beams):
    """Fill the beams (rings,) bool that can hit the box, and return its distance from the z axis."""
    near, far, bottom, top = 0.0, 0.0, np.inf, -np.inf
    for side in range(3):  # two sides of the box, and the direction towards it
        x, y = ahead if side == 2 else (box_axes[0, side], box_axes[1, side])
        length = max(math.hypot(x, y), 1e-9)
        low, high = np.inf, -np.inf
        for n in range(16):
            along = (x * corners[n, 0] + y * corners[n, 1]) / length
            low, high = min(low, along), max(high, along)
        near = max(near, low, -high)
    for n in range(16):
        far = max(far, math.hypot(corners[n, 0], corners[n, 1]))
        bottom, top = min(bottom, corners[n, 2]), max(top, corners[n, 2])
    for r in range(len(beams)):
        highest = grid.lift[r] + max(near * grid.rise[r], far * grid.rise[r])
        lowest = grid.lift[r] + min(near * grid.fall[r], far * grid.fall[r])
        beams[r] = highest >= bottom and lowest <= top and near <= grid.max_range
    return near
