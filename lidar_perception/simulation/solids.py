"""Things as solids: unit shapes under a linear map, with what their surface and owner are."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TypedDict

import numpy as np
from numba import njit

BOX, ELLIPSOID, CYLINDER = 0, 1, 2  # a cylinder stands along its z axis

# One part of a thing, in the thing's frame: x forward, y left, z up from the ground below its
# origin; metres, radians. half: half sizes along its own axes, which are turned by pitch about y
# (positive: nose down), then by yaw about z.
# semantic: SemanticKITTI class. reflectance 0..1; RETROREFLECTOR sends beams back where they come
# from, is as bright from anywhere and does not fade. density 1/m: inf is solid; foliage lets a beam
# through for 1 / density metres in the mean. transmission: share of the beams that pass, as through
# glass.
RETROREFLECTOR = 1.0
PART = np.dtype([("kind", np.int8), ("centre", np.float64, 3), ("half", np.float64, 3),
                 ("pitch", np.float64), ("yaw", np.float64), ("reflectance", np.float64),
                 ("semantic", np.uint16), ("density", np.float64), ("transmission", np.float64)])


class Surface(TypedDict, total=False):
    """What several parts are made of, see PART: arguments of part()."""

    reflectance: float
    transmission: float


def part(kind: int, centre: tuple, half: tuple, *, pitch: float = 0.0, yaw: float = 0.0,
         reflectance: float = 0.3, semantic: int = 0, density: float = np.inf,
         transmission: float = 0.0) -> tuple:
    """A row of PART; semantic 0 takes the class of its thing."""
    return kind, centre, half, pitch, yaw, reflectance, semantic, density, transmission


def parts(rows: list[tuple], semantic: int) -> np.ndarray:
    """(P,) PART of a thing; rows without a class of their own get this one."""
    made = np.array(rows, PART)
    made["semantic"] = np.where(made["semantic"] == 0, semantic, made["semantic"])
    return made


@dataclass(frozen=True)
class Solids:
    """P solids in the sensor's frame at the stamp: kind (P,) int8, centre (P, 3) m, half (P, 3) m,
    axes (P, 3, 3) with the solid's axes as columns, reflectance (P,), semantic (P,) uint16,
    density (P,) 1/m, transmission (P,), see PART; owner (P,) int32: the object that it belongs to,
    0 if none; velocity (P, 3) m/s over the ground, in the axes of the sensor's frame.
    The solids of an object stand together."""

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
        return Solids(*(getattr(self, f.name)[places] for f in fields(self)))


def place_parts(made: np.ndarray, base: np.ndarray, heading: np.ndarray, owner: np.ndarray,
                velocity: np.ndarray) -> Solids:
    """The solids of parts (P,) PART of things that stand at base (P, 3) and look along heading
    (P,); owner (P,) and velocity (P, 3) are copied."""
    cos, sin = np.cos(made["yaw"] + heading), np.sin(made["yaw"] + heading)
    down, nose = np.cos(made["pitch"]), np.sin(made["pitch"])
    zero = np.zeros(len(made))
    axes = np.stack([np.stack([cos * down, sin * down, -nose], axis=1),
                     np.stack([-sin, cos, zero], axis=1),
                     np.stack([cos * nose, sin * nose, down], axis=1)], axis=2)
    x, y, z = made["centre"].T
    ahead, aside = np.cos(heading), np.sin(heading)
    centre = base + np.stack([ahead * x - aside * y, aside * x + ahead * y, z], axis=1)
    return Solids(made["kind"], centre, made["half"].copy(), axes, made["reflectance"].copy(),
                  made["semantic"].copy(), made["density"].copy(), made["transmission"].copy(),
                  np.asarray(owner, np.int32), np.asarray(velocity, np.float64))


def compute_extents(made: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(P, 3) lower and (P, 3) upper bounds of each part, exact, in the thing's frame."""
    low, high = np.empty((len(made), 3)), np.empty((len(made), 3))
    _extents(made, low, high)
    return low, high


def compute_hull(made: np.ndarray, below: float = np.inf) -> tuple[float, ...]:
    """Bounds of all parts (P,) PART of which something is lower than that: least x, y, z, greatest
    x, y, z, in the thing's frame; inf and -inf where there are none."""
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
            low = (min(low[0], c[0] - reach[0]), min(low[1], c[1] - reach[1]),
                   min(low[2], c[2] - reach[2]))
            high = (max(high[0], c[0] + reach[0]), max(high[1], c[1] + reach[1]),
                    max(high[2], c[2] + reach[2]))
    return (*low, *high)


@njit(cache=True, nogil=True)
def _reach(one):
    """How far a part reaches along x, y, z from its centre."""
    cos, sin, down, nose = (math.cos(one.yaw), math.sin(one.yaw), math.cos(one.pitch),
                            math.sin(one.pitch))
    a, b, c = one.half[0], one.half[1], one.half[2]
    return (_along(one.kind, a * cos * down, b * sin, c * cos * nose),
            _along(one.kind, a * sin * down, b * cos, c * sin * nose),
            _along(one.kind, a * nose, 0.0, c * down))


@njit(cache=True, nogil=True)
def _along(kind, a, b, c):
    """Half the extent of a part whose half axes reach so far in a direction."""
    if kind == ELLIPSOID:
        return math.sqrt(a * a + b * b + c * c)
    if kind == CYLINDER:
        return math.hypot(a, b) + abs(c)
    return abs(a) + abs(b) + abs(c)
