"""Labelled things, their sizes, and primitives to build them: rods, discs, blocks and panes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import atan2, hypot, pi
from typing import NamedTuple

import numpy as np

from lidar_perception.simulation.solids import BOX, CYLINDER, RETROREFLECTOR, part

RUBBER, METAL, SKIN, GLASS, PLATE = 0.06, 0.3, 0.4, 0.04, RETROREFLECTOR

# Length, width, height in metres: mean and standard deviation, and the correlation of length and
# height, over the labels of 57 frames of KITTI's object training set and the tracks of 30 frames
# of tracking sequence 0000 (207 cars, 18 vans, 5 trucks, 4 trams, 15 pedestrians, 13 cyclists).
# They contain no sitting person: its mean is that of the whole training set, its spread a guess.
SIZES = {
    "Car": ((3.88, 1.62, 1.51), (0.47, 0.11, 0.11), 0.0),
    "Van": ((4.68, 1.83, 1.96), (0.59, 0.16, 0.19), 0.8),
    "Truck": ((11.2, 2.50, 3.26), (2.4, 0.09, 0.23), 0.0),
    "Tram": ((14.2, 2.52, 3.64), (1.3, 0.21, 0.14), 0.0),
    "Pedestrian": ((0.85, 0.60, 1.76), (0.19, 0.10, 0.10), 0.1),
    "Person_sitting": ((0.80, 0.60, 1.28), (0.08, 0.06, 0.06), 0.0),
    "Cyclist": ((1.81, 0.66, 1.72), (0.17, 0.13, 0.09), 0.5),
}


class Thing(NamedTuple):
    """A thing that KITTI labels. Mirrors and pushed objects may extend beyond its box.

    Attributes:
        parts: parts(metres travelled) -> (P,) PART.
        size: Length, width, height in m of the annotated box, the same for all poses, centred at
            (0, 0, height / 2).
        label: One of CLASSES.
    """

    parts: Callable[[float], np.ndarray]
    size: tuple[float, float, float]
    label: str


def make_rigid(made: np.ndarray, size: tuple[float, float, float], label: str) -> Thing:
    """Return a thing whose parts do not change."""
    return Thing(partial(_return_parts, made), size, label)


def _return_parts(made: np.ndarray, travelled: float) -> np.ndarray:
    return made


def draw_size(rng: np.random.Generator, label: str) -> tuple[float, float, float]:
    """Draw length, width and height in m like those of KITTI's boxes, within 2 standard deviations."""
    mean, spread, together = SIZES[label]
    z = rng.normal(size=3)
    z[2] = together * z[0] + np.sqrt(1 - together**2) * z[2]
    length, width, height = np.asarray(mean) + np.clip(z, -2, 2) * spread
    return float(length), float(width), float(height)


def interpolate(share: float, low: float, high: float) -> float:
    """Return low + share * (high - low), as rng.uniform for a number drawn by rng.random.

    Drawing many numbers at once takes a tenth of the time.
    """
    return low + (high - low) * share


def rod(start: tuple, end: tuple, radius: float, **surface) -> tuple:
    """Return a cylinder from start to end (x, y, z)."""
    x, y, z = end[0] - start[0], end[1] - start[1], end[2] - start[2]
    level = hypot(x, y)
    return part(
        CYLINDER,
        _midpoint(start, end),
        (radius, radius, hypot(level, z) / 2),
        yaw=atan2(y, x),
        pitch=atan2(level, z),
        **surface,
    )


def disc(centre: tuple, radius: float, half_width: float, **surface) -> tuple:
    """Return a cylinder along y, such as a wheel."""
    return part(CYLINDER, centre, (radius, radius, half_width), pitch=pi / 2, yaw=pi / 2, **surface)


def block(corner: tuple, opposite: tuple, **surface) -> tuple:
    """Return an upright box between two corners (x, y, z)."""
    (a, b, c), (x, y, z) = corner, opposite
    return part(BOX, _midpoint(corner, opposite), (abs(x - a) / 2, abs(y - b) / 2, abs(z - c) / 2), **surface)


def _midpoint(one: tuple, other: tuple) -> tuple:
    return (one[0] + other[0]) / 2, (one[1] + other[1]) / 2, (one[2] + other[2]) / 2


def slope(front: tuple, back: tuple, half_width: float, thickness: float = 0.01, **surface) -> tuple:
    """Return a thin board across y from front (x, z) to back (x, z), such as a windscreen."""
    (x0, z0), (x1, z1) = front, back
    return part(
        BOX,
        ((x0 + x1) / 2, 0.0, (z0 + z1) / 2),
        (hypot(x0 - x1, z0 - z1) / 2, half_width, thickness / 2),
        pitch=atan2(z1 - z0, x0 - x1),
        **surface,
    )


def upright_pane(x: tuple, low: tuple, high: tuple, thickness: float = 0.01, **surface) -> tuple:
    """Return a thin board from x[0] to x[1] with edges at low (y, z) and high (y, z).

    Such as the side window of a cabin that is narrower at the top.
    """
    (y0, z0), (y1, z1) = low, high
    return part(
        BOX,
        ((x[0] + x[1]) / 2, (y0 + y1) / 2, (z0 + z1) / 2),
        (thickness / 2, (x[1] - x[0]) / 2, hypot(y1 - y0, z1 - z0) / 2),
        yaw=pi / 2,
        pitch=atan2(y1 - y0, z1 - z0),
        **surface,
    )
