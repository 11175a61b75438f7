"""Which rays can meet a solid: a window of the grid of firings and beams."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidar_perception.simulation.sensor import STILL, Motion, Sensor
from lidar_perception.simulation.solids import BOX, ELLIPSOID, Solids

SIGNS = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).astype(np.float64)


class Windows(NamedTuple):
    """Of P solids: first (P,) int64 column, 0 .. columns - 1, and how many from there count (P,)
    int64, counted past the end; beams (P, rings) bool. No ray outside meets the solid, and none
    nearer than near (P,) m."""

    first: np.ndarray
    count: np.ndarray
    beams: np.ndarray
    near: np.ndarray


def windows(solids: Solids, sensor: Sensor, motion: Motion = STILL,
            margin: float = 0.0) -> Windows:
    """The windows of solids in the frame at the stamp; margin, radians: of rays that differ so
    much from the sensor's. Beams that start over each other are taken as they are."""
    relative = solids.velocity - np.asarray(motion.velocity, np.float64)
    since = sensor.times() - motion.stamp / sensor.rate
    whole = np.array([since.min(), since.max()])
    still = not relative.any() and not motion.yaw_rate
    span = np.tile(whole * (not still), (len(solids), 1))
    # From the time of the whole turn a window; from it the time for which the sensor looks there.
    for _ in range(1 if still else 3):
        corners, sides = _hull(solids, relative, span)
        first, count = _columns(corners, span * motion.yaw_rate, sensor, margin)
        latest = sensor.columns // 2 - first
        earliest = latest - count + 1
        same_turn = latest // sensor.columns == earliest // sensor.columns
        seen = np.stack([earliest, latest], axis=1) % sensor.columns / (
            sensor.columns * sensor.rate) - motion.stamp / sensor.rate
        span = np.where(same_turn[:, None], seen, whole)
    near, beams = _beams(corners, sides, sensor, margin)
    beams &= (near <= sensor.max_range)[:, None]
    return Windows(first % sensor.columns, count, beams, near - 1e-6)


def _hull(solids: Solids, relative: np.ndarray,
          span: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners (P, 16, 3) around a solid from one end of the span (P, 2) s to the other, and the
    level directions (P, 3, 2) of its sides and of its bearing."""
    ends = solids.centre[:, None] + relative[:, None] * span[..., None]
    ahead = ends.mean(axis=1)[:, :2]
    ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1), 1e-9)[:, None]
    zero = np.zeros(len(solids))
    # Around what is round a box that faces the sensor is tighter than one along its axes.
    facing = np.stack([np.column_stack([ahead, zero]),
                       np.column_stack([-ahead[:, 1], ahead[:, 0], zero]),
                       np.tile([0.0, 0.0, 1.0], (len(solids), 1))], axis=2)
    reach = np.abs(np.swapaxes(facing, 1, 2) @ (solids.axes * solids.half[:, None]))
    disc = np.hypot(reach[..., 0], reach[..., 1]) + reach[..., 2]
    extent = np.where((solids.kind == ELLIPSOID)[:, None],
                      np.sqrt((reach ** 2).sum(axis=2)), disc)
    box = solids.kind == BOX
    axes = np.where(box[:, None, None], solids.axes, facing)
    half = np.where(box[:, None], solids.half, extent)
    corners = np.swapaxes((axes * half[:, None]) @ SIGNS, 1, 2)
    corners = (ends[:, :, None] + corners[:, None]).reshape(-1, 16, 3)
    sides = np.stack([axes[:, :2, 0], axes[:, :2, 1], ahead], axis=1)
    return corners, sides / np.maximum(np.linalg.norm(sides, axis=2), 1e-9)[..., None]


def _columns(corners: np.ndarray, turned: np.ndarray, sensor: Sensor,
             margin: float) -> tuple[np.ndarray, np.ndarray]:
    """First column and how many, (P,) int64, for a sensor that has turned by (P, 2) radians."""
    middle = np.arctan2(corners[..., 1].sum(axis=1), corners[..., 0].sum(axis=1))
    bearing = np.arctan2(corners[..., 1], corners[..., 0]) - middle[:, None]
    bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
    low, high = bearing.min(axis=1), bearing.max(axis=1)
    around = high - low >= np.pi  # the sensor is within the hull's shadow
    wide = margin / np.cos(np.abs(sensor.elevations).max())
    low, high = low - turned.max(axis=1) - wide, high - turned.min(axis=1) + wide
    step = 2 * np.pi / sensor.columns
    first = np.floor((middle + low) / step).astype(np.int64)
    count = np.ceil((middle + high) / step).astype(np.int64) - first + 1
    around |= count >= sensor.columns
    return np.where(around, 0, first), np.where(around, sensor.columns, count)


def _beams(corners: np.ndarray, sides: np.ndarray, sensor: Sensor,
           margin: float) -> tuple[np.ndarray, np.ndarray]:
    """How near the hull comes to the z axis (P,), and which beams reach its height (P, rings)."""
    along = np.einsum("psi,pci->psc", sides, corners[..., :2])
    near = np.maximum(along.min(axis=2), -along.max(axis=2)).max(axis=1).clip(0.0)
    far = np.linalg.norm(corners[..., :2], axis=2).max(axis=1)
    bottom, top = corners[..., 2].min(axis=1)[:, None], corners[..., 2].max(axis=1)[:, None]
    lift = sensor.origins()[:, 2]
    limit = np.pi / 2 - 1e-6
    rise, fall = (np.tan(np.clip(np.asarray(sensor.elevations) + m, -limit, limit))
                  for m in (margin + 1e-9, -margin - 1e-9))
    highest = lift + np.maximum(near[:, None] * rise, far[:, None] * rise)
    lowest = lift + np.minimum(near[:, None] * fall, far[:, None] * fall)
    return near, (highest >= bottom) & (lowest <= top)
