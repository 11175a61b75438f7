"""Solids: boxes, ellipsoids and cylinders with their surface properties and owner."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numba import njit

BOX, ELLIPSOID, CYLINDER = 0, 1, 2  # kinds of solids; the axis of a cylinder is z

# One part of an object, in the object's frame: x forward, y left, z up from the ground below its
# origin; metres, radians.
# half_size: half sizes along the part's axes, which are rotated by pitch about y (positive: nose down),
# then by yaw about z.
# semantic: SemanticKITTI class.
# reflectance: 0..1; a RETROREFLECTOR is equally bright from all directions and at all ranges.
# density: 1/m, inf for opaque parts; the mean free path of a beam in foliage is 1 / density.
# transmission: fraction of beams that pass through, as through glass.
RETROREFLECTOR = 1.0
PART = np.dtype(
    [
        ("kind", np.int8),
        ("centre", np.float64, 3),
        ("half_size", np.float64, 3),
        ("pitch", np.float64),
        ("yaw", np.float64),
        ("reflectance", np.float64),
        ("semantic", np.uint16),
        ("density", np.float64),
        ("transmission", np.float64),
    ]
)


def make_part_row(
    kind: int,
    centre: tuple,
    half_size: tuple,
    reflectance: float,
    *,
    pitch: float = 0.0,
    yaw: float = 0.0,
    semantic: int = 0,
    density: float = np.inf,
    transmission: float = 0.0,
) -> tuple:
    """Return a row of PART. With semantic 0, make_parts sets the class of the object."""
    return kind, centre, half_size, pitch, yaw, reflectance, semantic, density, transmission


def make_parts(rows: list[tuple], semantic: int) -> np.ndarray:
    """Convert rows to (P,) PART. Rows with class 0 get the class `semantic`."""
    parts = np.array(rows, PART)
    parts["semantic"] = np.where(parts["semantic"] == 0, semantic, parts["semantic"])
    return parts


@dataclass(frozen=True)
class Solids:
    """P solids in the sensor's frame at the stamp. The solids of an object are consecutive.

    Attributes:
        kind: (P,) int8.
        centre, half_size: (P, 3) m.
        axes: (P, 3, 3) axes of the solid as columns.
        reflectance, transmission: (P,), see PART.
        semantic: (P,) uint16.
        density: (P,) 1/m.
        owner: (P,) int32 track id of the object, 0 for none.
        velocity: (P, 3) m/s over the ground, along the axes of the sensor's frame.
    """

    kind: np.ndarray
    centre: np.ndarray
    half_size: np.ndarray
    axes: np.ndarray
    reflectance: np.ndarray
    semantic: np.ndarray
    density: np.ndarray
    transmission: np.ndarray
    owner: np.ndarray
    velocity: np.ndarray

    def __len__(self) -> int:
        return len(self.kind)

    def take(self, indices: np.ndarray) -> Solids:
        """Return the solids at these indices."""
        return Solids(*(getattr(self, f.name)[indices] for f in fields(self)))


def place_parts(
    parts: np.ndarray, position: np.ndarray, heading: np.ndarray, owner: np.ndarray, velocity: np.ndarray
) -> Solids:
    """Transform parts from the frames of their objects to the sensor's frame.

    Args:
        parts: (P,) PART, parts of one or more objects.
        position: (P, 3) position of each part's object in m.
        heading: (P,) heading of each part's object in rad.
        owner, velocity: (P,) and (P, 3), see Solids.
    """
    cos, sin = np.cos(parts["yaw"] + heading), np.sin(parts["yaw"] + heading)
    cos_pitch, sin_pitch = np.cos(parts["pitch"]), np.sin(parts["pitch"])
    zero = np.zeros(len(parts))
    axes = np.stack(
        [
            np.stack([cos * cos_pitch, sin * cos_pitch, -sin_pitch], axis=1),
            np.stack([-sin, cos, zero], axis=1),
            np.stack([cos * sin_pitch, sin * sin_pitch, cos_pitch], axis=1),
        ],
        axis=2,
    )
    x, y, z = parts["centre"].T
    cos_heading, sin_heading = np.cos(heading), np.sin(heading)
    centre = position + np.stack([cos_heading * x - sin_heading * y, sin_heading * x + cos_heading * y, z], axis=1)
    return Solids(
        parts["kind"],
        centre,
        parts["half_size"].copy(),
        axes,
        parts["reflectance"].copy(),
        parts["semantic"].copy(),
        parts["density"].copy(),
        parts["transmission"].copy(),
        np.asarray(owner, np.int32),
        np.asarray(velocity, np.float64),
    )


def compute_extents(parts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the exact lower and upper bounds of each part, (P, 3) each, in the object's frame."""
    low, high = np.empty((len(parts), 3)), np.empty((len(parts), 3))
    _fill_extents(parts, low, high)
    return low, high


def compute_hull(parts: np.ndarray, max_bottom: float = np.inf) -> tuple[float, ...]:
    """Return min x, y, z and max x, y, z of all parts whose lower end is below max_bottom.

    The result is inf and -inf if there are no such parts.
    """
    return _compute_hull(parts, max_bottom)


@njit(cache=True, nogil=True)
def _fill_extents(parts, low, high):
    for p in range(len(parts)):
        half_extents = _compute_half_extents(parts[p])
        for i in range(3):
            low[p, i], high[p, i] = parts[p].centre[i] - half_extents[i], parts[p].centre[i] + half_extents[i]


@njit(cache=True, nogil=True)
def _compute_hull(parts, max_bottom):
    low, high = (np.inf, np.inf, np.inf), (-np.inf, -np.inf, -np.inf)
    for p in range(len(parts)):
        c, half_extents = parts[p].centre, _compute_half_extents(parts[p])
        if c[2] - half_extents[2] < max_bottom:
            low = (
                min(low[0], c[0] - half_extents[0]),
                min(low[1], c[1] - half_extents[1]),
                min(low[2], c[2] - half_extents[2]),
            )
            high = (
                max(high[0], c[0] + half_extents[0]),
                max(high[1], c[1] + half_extents[1]),
                max(high[2], c[2] + half_extents[2]),
            )
    return (*low, *high)


@njit(cache=True, nogil=True)
def _compute_half_extents(part):
    """Return half of the extents of a part along x, y and z."""
    cos, sin, cos_pitch, sin_pitch = (
        math.cos(part.yaw),
        math.sin(part.yaw),
        math.cos(part.pitch),
        math.sin(part.pitch),
    )
    a, b, c = part.half_size[0], part.half_size[1], part.half_size[2]
    return (
        _compute_half_extent(part.kind, a * cos * cos_pitch, b * sin, c * cos * sin_pitch),
        _compute_half_extent(part.kind, a * sin * cos_pitch, b * cos, c * sin * sin_pitch),
        _compute_half_extent(part.kind, a * sin_pitch, 0.0, c * cos_pitch),
    )


@njit(cache=True, nogil=True)
def _compute_half_extent(kind, a, b, c):
    """Return half of the extent of a part in a direction, given the components of its half axes."""
    if kind == ELLIPSOID:
        return math.sqrt(a * a + b * b + c * c)
    if kind == CYLINDER:
        return math.hypot(a, b) + abs(c)
    return abs(a) + abs(b) + abs(c)
