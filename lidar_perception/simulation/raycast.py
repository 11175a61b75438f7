"""Rays from the LiDAR against solids and the ground.

The rays lie on a grid of firings (columns) and lasers (rings), so that a solid needs to be tested
only against its window of the grid, with the nearest hit kept per ray as in a depth buffer.
All solids are unit shapes under a linear map; a ray enters a unit shape where it has entered all
the slabs and quadrics that bound it (Kay and Kajiya, SIGGRAPH 1986).
Solids are in the LiDAR frame; the ground is in the world, whose axes are parallel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from lidar_perception.simulation.sensor import Sensor
from lidar_perception.simulation.terrain import Ground, cast_ground, shine

BOX, ELLIPSOID, CYLINDER = 0, 1, 2  # a cylinder stands along its z axis


@dataclass(frozen=True)
class Solids:
    """P solids: kind (P,), centre (P, 3) m, half (P, 3) m half sizes along the solid's axes,
    axes (P, 3, 3) with these axes as columns, reflectance (P,) 0..1, owner (P,) int: the object
    that it belongs to, 0 if none. The solids of an object stand together."""

    kind: np.ndarray
    centre: np.ndarray
    half: np.ndarray
    axes: np.ndarray
    reflectance: np.ndarray
    owner: np.ndarray


class Hits(NamedTuple):
    """What each ray meets first, without noise. (columns, rings) float64 range m, inf where
    nothing; brightness 0..1; owner int32, 0 where no object. reached[k] rays would meet object k
    if it were alone."""

    range: np.ndarray
    brightness: np.ndarray
    owner: np.ndarray
    reached: np.ndarray


def cast(solids: Solids, ground: Ground, position: np.ndarray, sensor: Sensor) -> Hits:
    """Cast all rays of one turn. position (3,): the sensor in the world, between the curbs."""
    directions = sensor.directions()
    nearest, brightness = cast_ground(ground, np.asarray(position, np.float64), directions,
                                       sensor.max_range)
    owner = np.zeros(nearest.shape, np.int32)
    reached = np.zeros(int(solids.owner.max(initial=0)) + 1, np.int64)
    to_unit = np.ascontiguousarray(np.swapaxes(solids.axes, 1, 2) / solids.half[:, :, None])
    _cast_solids(solids.kind.astype(np.int64), to_unit,
                 -np.einsum("pij,pj->pi", to_unit, solids.centre),
                 np.ascontiguousarray(solids.reflectance, np.float64),
                 solids.owner.astype(np.int32), _windows(solids, sensor), directions, nearest,
                 brightness, owner, reached)
    return Hits(nearest, brightness, owner, reached)


def measure(hits: Hits, sensor: Sensor,
            rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the sensor reports: xyz (N, 3) float32, intensity (N,) float32, owner (N,) int32.

    Ranges get Gaussian noise, brightness 10 % speckle, and far returns are lost more often.
    """
    noisy = hits.range + rng.normal(0.0, sensor.range_noise, hits.range.shape)
    lost = rng.random(noisy.shape) < sensor.dropout * hits.range / sensor.max_range
    speckle = rng.normal(1.0, 0.1, noisy.shape)
    # A hair within the limits, so that rounding to float32 does not step over them.
    keep = ~lost & (noisy > sensor.min_range + 1e-4) & (noisy < sensor.max_range - 1e-4)
    xyz = sensor.directions()[keep] * noisy[keep, None]
    intensity = np.clip(hits.brightness[keep] * speckle[keep], 0.0, 1.0)
    return xyz.astype(np.float32), intensity.astype(np.float32), hits.owner[keep]


def _windows(solids: Solids, sensor: Sensor) -> np.ndarray:
    """(P, 4) int64 [first column, columns, first ring, end ring] that hold every ray which can
    meet the solid; no columns where it is out of range."""
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8)
    corners = (solids.axes * solids.half[:, None]) @ signs + solids.centre[:, :, None]
    # Bearings from the centre's bearing; they span half a turn only if the sensor is between.
    middle = np.arctan2(solids.centre[:, 1], solids.centre[:, 0])
    bearing = np.arctan2(corners[:, 1], corners[:, 0]) - middle[:, None]
    bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
    low, high = bearing.min(axis=1), bearing.max(axis=1)
    around = high - low >= np.pi
    step = 2 * np.pi / sensor.columns
    first = np.floor((middle + low) / step).astype(np.int64)
    count = np.ceil((middle + high) / step).astype(np.int64) - first + 1
    first, count = np.where(around, 0, first), np.where(around, sensor.columns, count)

    reach = np.hypot(corners[:, 0] - solids.centre[:, :1],
                     corners[:, 1] - solids.centre[:, 1:2]).max(axis=1)
    distance = np.hypot(solids.centre[:, 0], solids.centre[:, 1])
    near, far = np.maximum(distance - reach, 1e-9), distance + reach
    bottom, top = corners[:, 2].min(axis=1), corners[:, 2].max(axis=1)
    lowest = np.arctan2(bottom, np.where(bottom < 0, near, far)) - 1e-9
    highest = np.arctan2(top, np.where(top > 0, near, far)) + 1e-9
    falling = -np.asarray(sensor.elevations)
    count[near > sensor.max_range] = 0
    return np.stack([first, count, np.searchsorted(falling, -highest),
                     np.searchsorted(falling, -lowest, side="right")], axis=1)


@njit(cache=True)
def _enter(kind, o, d):
    """Range at which a ray from outside enters the unit shape; inf if it misses."""
    enter, leave = -np.inf, np.inf
    first_slab = 0 if kind == BOX else 2 if kind == CYLINDER else 3
    for i in range(first_slab, 3):
        if d[i] == 0.0:
            if abs(o[i]) > 1.0:
                return np.inf
        else:
            a, b = (-1.0 - o[i]) / d[i], (1.0 - o[i]) / d[i]
            enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    if kind != BOX:
        a = d[0] * d[0] + d[1] * d[1]
        b = o[0] * d[0] + o[1] * d[1]
        c = o[0] * o[0] + o[1] * o[1] - 1.0
        if kind == ELLIPSOID:
            a, b, c = a + d[2] * d[2], b + o[2] * d[2], c + o[2] * o[2]
        square = b * b - a * c
        if a == 0.0 or square < 0.0:
            return np.inf  # a ray exactly along a cylinder is taken as a miss
        root = np.sqrt(square)
        enter, leave = max(enter, (-b - root) / a), min(leave, (-b + root) / a)
    return enter if 0.0 < enter <= leave else np.inf


@njit(cache=True)
def _normal(kind, p):
    """Outward direction of the unit shape at its surface point p."""
    n = p.copy()
    if kind == BOX:
        face = np.argmax(np.abs(p))
        for i in range(3):
            if i != face:
                n[i] = 0.0
    elif kind == CYLINDER:
        if p[2] * p[2] > p[0] * p[0] + p[1] * p[1]:
            n[0] = n[1] = 0.0
        else:
            n[2] = 0.0
    return n


@njit(cache=True)
def _cast_solids(kind, to_unit, origin, reflectance, solid_owner, windows, directions, nearest,
                 brightness, owner, reached):
    """Writes the solids into nearest, brightness and owner, and counts reached."""
    columns = directions.shape[0]
    last = np.zeros(nearest.shape, np.int32)  # the object that last met the ray
    d = np.empty(3)
    for s in range(len(kind)):
        m, o, k = to_unit[s], origin[s], solid_owner[s]
        for i in range(windows[s, 1]):
            c = (windows[s, 0] + i) % columns
            for r in range(windows[s, 2], windows[s, 3]):
                ray = directions[c, r]
                for j in range(3):
                    d[j] = m[j, 0] * ray[0] + m[j, 1] * ray[1] + m[j, 2] * ray[2]
                t = _enter(kind[s], o, d)
                if t == np.inf:
                    continue
                if last[c, r] != k:
                    last[c, r] = k
                    reached[k] += 1
                if t < nearest[c, r]:
                    nearest[c, r] = t
                    owner[c, r] = k
                    n = _normal(kind[s], o + t * d)
                    along = square = 0.0
                    for j in range(3):
                        component = m[0, j] * n[0] + m[1, j] * n[1] + m[2, j] * n[2]
                        along += component * ray[j]
                        square += component * component
                    brightness[c, r] = shine(reflectance[s], abs(along) / np.sqrt(square))
