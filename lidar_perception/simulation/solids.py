"""Solids: unit shapes under a linear map, with their surface and owner."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TypedDict

import numpy as np
from numba import njit

BOX, ELLIPSOID, CYLINDER = 0, 1, 2  # kinds of solids; a cylinder's axis is z

# One part of an object, in the object's frame: x forward, y left, z up from the ground below its
# origin; metres, radians.
# half: half sizes along the part's axes, which are rotated by pitch about y (positive: nose down),
# then by yaw about z.
# semantic: SemanticKITTI class.
# reflectance: 0..1; a RETROREFLECTOR is equally bright from all directions and does not fade.
# density: 1/m; inf is solid; a beam penetrates foliage by 1 / density metres on average.
# transmission: fraction of beams that pass, for example through glass.
RETROREFLECTOR = 1.0
PART = np.dtype(
    [
        ("kind", np.int8),
        ("centre", np.float64, 3),
        ("half", np.float64, 3),
        ("pitch", np.float64),
        ("yaw", np.float64),
        ("reflectance", np.float64),
        ("semantic", np.uint16),
        ("density", np.float64),
        ("transmission", np.float64),
    ]
)


class Surface(TypedDict, total=False):
    """Surface that several parts share: arguments of part(), see PART."""

    reflectance: float
    transmission: float


def part(
    kind: int,
    centre: tuple,
    half: tuple,
    *,
    pitch: float = 0.0,
    yaw: float = 0.0,
    reflectance: float = 0.3,
    semantic: int = 0,
    density: float = np.inf,
    transmission: float = 0.0,
) -> tuple:
    """Return a row of PART; semantic 0 takes the class of its thing."""
    return kind, centre, half, pitch, yaw, reflectance, semantic, density, transmission


def parts(rows: list[tuple], semantic: int) -> np.ndarray:
    """Return the rows of a thing as (P,) PART; rows without a class get this one."""
    made = np.array(rows, PART)
    made["semantic"] = np.where(made["semantic"] == 0, semantic, made["semantic"])
    return made


@dataclass(frozen=True)
class Solids:
    """P solids in the sensor's frame at the stamp; those of an object are consecutive.

    Attributes:
        kind: (P,) int8.
        centre, half: (P, 3) m.
        axes: (P, 3, 3), the solid's axes as columns.
        reflectance, transmission: (P,), see PART.
        semantic: (P,) uint16.
        density: (P,) 1/m.
        owner: (P,) int32 object, 0 for none.
        velocity: (P, 3) m/s over the ground, in the axes of the sensor's frame.
    """

    kind: np.ndarray
    centre: np.ndarray
    half: np.ndarray
    axes: np.ndarray
    reflectance: np.ndarray
    semantic: np.ndarray
    density: np.ndarray
    transmission: np.ndarray
    owner: np.ndarray
    velocity: np.ndarray

    def __len__(self) -> int:
        return len(self.kind)

    def take(self, places: np.ndarray) -> Solids:
        """Return the solids at these indices."""
        return Solids(*(getattr(self, f.name)[places] for f in fields(self)))


def place_parts(
    made: np.ndarray, base: np.ndarray, heading: np.ndarray, owner: np.ndarray, velocity: np.ndarray
) -> Solids:
    """Place parts in the frame of the sensor.

    Args:
        made: (P,) PART, parts of one or more things.
        base, heading: (P, 3) positions in m and (P,) headings in rad of the things.
        owner, velocity: (P,) and (P, 3), see Solids.
    """
    cos, sin = np.cos(made["yaw"] + heading), np.sin(made["yaw"] + heading)
    down, nose = np.cos(made["pitch"]), np.sin(made["pitch"])
    zero = np.zeros(len(made))
    axes = np.stack(
        [
            np.stack([cos * down, sin * down, -nose], axis=1),
            np.stack([-sin, cos, zero], axis=1),
            np.stack([cos * nose, sin * nose, down], axis=1),
        ],
        axis=2,
    )
    x, y, z = made["centre"].T
    ahead, aside = np.cos(heading), np.sin(heading)
    centre = base + np.stack([ahead * x - aside * y, aside * x + ahead * y, z], axis=1)
    return Solids(
        made["kind"],
        centre,
        made["half"].copy(),
        axes,
        made["reflectance"].copy(),
        made["semantic"].copy(),
        made["density"].copy(),
        made["transmission"].copy(),
        np.asarray(owner, np.int32),
        np.asarray(velocity, np.float64),
    )


def compute_extents(made: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return exact lower and upper bounds of each part, (P, 3) each, in the thing's frame."""
    low, high = np.empty((len(made), 3)), np.empty((len(made), 3))
    _extents(made, low, high)
    return low, high


def compute_hull(made: np.ndarray, below: float = np.inf) -> tuple[float, ...]:
    """Return the bounds of all parts that reach below a height, in the thing's frame.

    They are least x, y, z and greatest x, y, z; inf and -inf without such parts.
    """
    return _hull(made, below)


@njit(cache=True, nogil=True)
def _extents(made, low, high):
    for p in range(len(made)):
        reach = _reach(made[p])
        for i in range(3):
            low[p, i], high[p, i] = made[p].centre[i] - reach[i], made[p].centre[i] + reach[i]


@njit(cache=True, nogil=True)
def _hull(made, below):
    low, high = (np.inf, np.inf, np.inf), (-np.inf, -np.inf, -np.inf)
    for p in range(len(made)):
        c, reach = made[p].centre, _reach(made[p])
        if c[2] - reach[2] < below:
            low = (min(low[0], c[0] - reach[0]), min(low[1], c[1] - reach[1]), min(low[2], c[2] - reach[2]))
            high = (max(high[0], c[0] + reach[0]), max(high[1], c[1] + reach[1]), max(high[2], c[2] + reach[2]))
    return (*low, *high)


@njit(cache=True, nogil=True)
def _reach(one):
    """Return how far a part reaches along x, y and z from its centre."""
    cos, sin, down, nose = (math.cos(one.yaw), math.sin(one.yaw), math.cos(one.pitch), math.sin(one.pitch))
    a, b, c = one.half[0], one.half[1], one.half[2]
    return (
        _along(one.kind, a * cos * down, b * sin, c * cos * nose),
        _along(one.kind, a * sin * down, b * cos, c * sin * nose),
        _along(one.kind, a * nose, 0.0, c * down),
    )


@njit(cache=True, nogil=True)
def _along(kind, a, b, c):
    """Return half the extent of a part in a direction, given the extents of its half axes."""
    if kind == ELLIPSOID:
        return math.sqrt(a * a + b * b + c * c)
    if kind == CYLINDER:
        return math.hypot(a, b) + abs(c)
    return abs(a) + abs(b) + abs(c)
