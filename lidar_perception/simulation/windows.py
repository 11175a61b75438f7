"""Windows of solids: their bounding rectangles in the grid of firings and beams."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from lidar_perception.simulation.sensor import NO_MOTION, Motion, Sensor
from lidar_perception.simulation.solids import BOX, ELLIPSOID, Solids


class Windows(NamedTuple):
    """Bounding windows of P solids. Only rays in the window of a solid can hit it.

    Attributes:
        first: (P,) int64 first column, 0 .. columns - 1.
        count: (P,) int64 number of columns; windows wrap around from the last column to column 0.
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
        begin, end: Start and end of the revolution, seconds relative to the stamp.
        margin: Margin in azimuth, rad.
        is_moving: True if the sensor or a solid moves.
        lift: (rings,) start of each beam on the z axis, m.
        max_slope, min_slope: (rings,) slopes of the highest and the lowest ray of each beam.
    """

    columns: int
    rate: float
    stamp: float
    yaw_rate: float
    begin: float
    end: float
    margin: float
    max_range: float
    is_moving: bool
    lift: np.ndarray
    max_slope: np.ndarray
    min_slope: np.ndarray


def find_windows(solids: Solids, sensor: Sensor, motion: Motion = NO_MOTION, margin: float = 0.0) -> Windows:
    """Find the windows of solids.

    Args:
        solids: Solids in the sensor's frame at the stamp.
        sensor: The sensor.
        motion: Motion of the sensor.
        margin: Largest angle between a ray and its beam, rad.
    """
    relative_velocity = solids.velocity - np.asarray(motion.velocity, np.float64)
    times = sensor.compute_firing_times() - motion.stamp / sensor.rate
    elevations, limit = np.asarray(sensor.elevations), np.pi / 2 - 1e-6
    max_slope, min_slope = (np.tan(np.clip(elevations + m, -limit, limit)) for m in (margin + 1e-9, -margin - 1e-9))
    grid = Grid(
        sensor.columns,
        float(sensor.rate),
        float(motion.stamp),
        float(motion.yaw_rate),
        float(times.min()),
        float(times.max()),
        float(margin / np.cos(np.abs(elevations).max())),
        float(sensor.max_range),
        bool(relative_velocity.any() or motion.yaw_rate),
        sensor.compute_origins()[:, 2].copy(),
        max_slope,
        min_slope,
    )
    count = len(solids)
    windows = Windows(
        np.empty(count, np.int64), np.empty(count, np.int64), np.empty((count, sensor.rings), bool), np.empty(count)
    )
    arrays = (
        np.array(values, float, order="C")
        for values in (solids.centre, solids.half_size, solids.axes, relative_velocity)
    )
    _fill_windows(windows, grid, np.array(solids.kind), *arrays)
    return windows


@njit(cache=True, nogil=True)
def _fill_windows(windows, grid, kind, centre, half_size, axes, relative_velocity):
    corners, box_axes, box_half = np.empty((16, 3)), np.empty((3, 3)), np.empty(3)
    for p in range(len(kind)):
        # Iterate: the window of the full revolution limits the time at which the sensor faces the solid.
        begin, end = (grid.begin, grid.end) if grid.is_moving else (0.0, 0.0)
        for _ in range(3 if grid.is_moving else 1):
            direction = _find_direction(centre[p], relative_velocity[p], (begin + end) / 2)
            _fill_corners(
                corners,
                box_axes,
                box_half,
                kind[p],
                centre[p],
                half_size[p],
                axes[p],
                relative_velocity[p],
                direction,
                begin,
                end,
            )
            first, count = _find_columns(corners, grid, begin, end)
            last_firing = grid.columns // 2 - first
            first_firing = last_firing - count + 1
            begin, end = grid.begin, grid.end
            if last_firing // grid.columns == first_firing // grid.columns:
                firing_rate = grid.columns * grid.rate
                begin = first_firing % grid.columns / firing_rate - grid.stamp / grid.rate
                end = last_firing % grid.columns / firing_rate - grid.stamp / grid.rate
        windows.first[p], windows.count[p] = first % grid.columns, count
        windows.min_range[p] = _fill_beams(corners, box_axes, direction, grid, windows.beams[p]) - 1e-6


@njit(cache=True, nogil=True)
def _find_direction(centre, relative_velocity, time):
    """Return the horizontal direction (x, y) from the sensor to a solid at a time."""
    x, y = centre[0] + relative_velocity[0] * time, centre[1] + relative_velocity[1] * time
    distance = max(math.hypot(x, y), 1e-9)
    return x / distance, y / distance


@njit(cache=True, nogil=True)
def _fill_corners(corners, box_axes, box_half, kind, centre, half_size, axes, relative_velocity, direction, begin, end):
    """Fill in a box around a solid: its axes, half sizes, and corners (16, 3) at the times begin and end.

    The box of a round solid faces the sensor, which makes it tighter.
    """
    if kind == BOX:
        box_axes[:] = axes
        box_half[:] = half_size
    else:
        box_axes[:] = 0.0
        box_axes[0, 0], box_axes[1, 0] = direction
        box_axes[0, 1], box_axes[1, 1] = -direction[1], direction[0]
        box_axes[2, 2] = 1.0
        for i in range(3):
            a, b, c = 0.0, 0.0, 0.0
            for j in range(3):
                a += box_axes[j, i] * axes[j, 0] * half_size[0]
                b += box_axes[j, i] * axes[j, 1] * half_size[1]
                c += box_axes[j, i] * axes[j, 2] * half_size[2]
            if kind == ELLIPSOID:
                box_half[i] = math.sqrt(a * a + b * b + (c * c))
            else:
                box_half[i] = math.sqrt(a * a + b * b) + abs(c)
    for n in range(16):
        time = begin if n < 8 else end
        for i in range(3):
            corners[n, i] = centre[i] + relative_velocity[i] * time
            for j in range(3):
                corners[n, i] += box_axes[i, j] * (box_half[j] if n >> j & 1 else -box_half[j])


@njit(cache=True, nogil=True)
def _find_columns(corners, grid, begin, end):
    """Return the first column and the number of columns of a window, including the rotation of the sensor."""
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
def _fill_beams(corners, box_axes, direction, grid, beams):
    """Fill in the beams (rings,) bool that can hit the box, and return its distance from the z axis."""
    min_distance, max_distance, bottom, top = 0.0, 0.0, np.inf, -np.inf
    for side in range(3):  # the normals of two sides of the box, and the direction towards it
        x, y = direction if side == 2 else (box_axes[0, side], box_axes[1, side])
        length = max(math.hypot(x, y), 1e-9)
        low, high = np.inf, -np.inf
        for n in range(16):
            projection = (x * corners[n, 0] + y * corners[n, 1]) / length
            low, high = min(low, projection), max(high, projection)
        min_distance = max(min_distance, low, -high)
    for n in range(16):
        max_distance = max(max_distance, math.hypot(corners[n, 0], corners[n, 1]))
        bottom, top = min(bottom, corners[n, 2]), max(top, corners[n, 2])
    for r in range(len(beams)):
        highest = grid.lift[r] + max(min_distance * grid.max_slope[r], max_distance * grid.max_slope[r])
        lowest = grid.lift[r] + min(min_distance * grid.min_slope[r], max_distance * grid.min_slope[r])
        beams[r] = highest >= bottom and lowest <= top and min_distance <= grid.max_range
    return min_distance
