"""Compiled intersection of one ray with one solid.

A solid is a unit shape under a linear map. A unit shape is the intersection of slabs and quadrics
(Kay and Kajiya, SIGGRAPH 1986).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from lidar_perception.simulation.foliage import trace_foliage
from lidar_perception.simulation.hashing import hash_uniform
from lidar_perception.simulation.sensor import Motion
from lidar_perception.simulation.solids import BOX, CYLINDER, ELLIPSOID, Solids
from lidar_perception.simulation.terrain import compute_brightness


class CompiledSolids(NamedTuple):
    """P solids for compiled code. Other attributes are those of Solids.

    Attributes:
        matrix: (P, 3, 3) linear map from the sensor's frame to the unit shape.
        offset: (P, 3) origin of the sensor's frame in the frame of the unit shape.
        drift: (P, 3) velocity of the sensor relative to the solid, in the frame of the unit shape.
        plant: (P,) uint64 seed of the leaves.
        salt: (P,) uint64 seed of all other random numbers.
    """

    matrix: np.ndarray
    offset: np.ndarray
    drift: np.ndarray
    kind: np.ndarray
    density: np.ndarray
    transmission: np.ndarray
    reflectance: np.ndarray
    plant: np.ndarray
    owner: np.ndarray
    semantic: np.ndarray
    salt: np.ndarray


def compile_solids(solids: Solids, motion: Motion, salt: np.uint64) -> CompiledSolids:
    """Convert solids for compiled code; motion: motion of the sensor; salt: seed of the scan."""
    matrix = np.swapaxes(solids.axes, 1, 2) / solids.half[:, :, None]
    slides = np.asarray(motion.velocity, np.float64) - solids.velocity
    # Copies, since Numba would compile again for read-only arrays and other memory layouts.
    density, transmission, reflectance = (
        np.array(part, np.float64) for part in (solids.density, solids.transmission, solids.reflectance)
    )
    return CompiledSolids(
        np.array(matrix, order="C"),
        -np.einsum("pij,pj->pi", matrix, solids.centre),
        np.einsum("pij,pj->pi", matrix, slides),
        np.array(solids.kind),
        density,
        transmission,
        reflectance,
        reflectance.view(np.uint64),
        np.array(solids.owner),
        np.array(solids.semantic),
        (np.arange(len(solids), dtype=np.uint64) << np.uint64(32)) + salt,
    )


@njit(cache=True, nogil=True)
def to_unit_frame(shapes, s, direction, since, lift):
    """Transform a ray to the frame of unit shape s: start and direction (x, y, z).

    Args:
        shapes: CompiledSolids.
        s: Index of the solid.
        direction: Direction (x, y, z) of the ray in the sensor's frame.
        since: Time of the ray after the stamp, s.
        lift: Start of the ray on the z axis, m.
    """
    m, o, v = shapes.matrix[s], shapes.offset[s], shapes.drift[s]
    start = (
        o[0] + m[0, 2] * lift + v[0] * since,
        o[1] + m[1, 2] * lift + v[1] * since,
        o[2] + m[2, 2] * lift + v[2] * since,
    )
    x, y, z = direction
    return start, (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z,
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z,
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def intersect_shape(kind, start, direction):
    """Return the ranges at which a ray enters and leaves a unit shape, (inf, -inf) for a miss.

    A ray exactly along the axis of a cylinder or in the face of a box is a miss.
    """
    enter, leave = -np.inf, np.inf
    for i in range(3):
        if kind == BOX or (kind == CYLINDER and i == 2):
            inverse = 1 / direction[i]
            a, b = (-1 - start[i]) * inverse, (1 - start[i]) * inverse
            if math.isnan(a) or math.isnan(b):
                return np.inf, -np.inf
            enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    if kind != BOX:
        (x, y, z), (u, v, w) = start, direction
        if kind == CYLINDER:  # distance from the axis, not from the centre
            z, w = 0.0, 0.0
        square = u * u + v * v + w * w
        middle = -(x * u + y * v + z * w) / square
        x, y, z = x + middle * u, y + middle * v, z + middle * w
        half = (1 - (x * x + y * y + z * z)) / square
        if not half >= 0:
            return np.inf, -np.inf
        half = math.sqrt(half)
        enter, leave = max(enter, middle - half), min(leave, middle + half)
    return enter, leave


@njit(cache=True, nogil=True, error_model="numpy")
def find_stop_range(shapes, s, start, direction, enter, leave, number, leaf_share):
    """Return the range at which solid s stops a ray, inf if the ray passes through leaves or glass.

    A ray that starts in an opaque solid is not stopped. number: number of the ray; leaf_share: see
    foliage.py.
    """
    t = enter if enter > 0 else np.inf
    key = shapes.salt[s] + np.uint64(number)
    if shapes.density[s] < np.inf:
        m = shapes.matrix[s]
        half = (
            1 / math.sqrt(m[0, 0] ** 2 + m[0, 1] ** 2 + m[0, 2] ** 2),
            1 / math.sqrt(m[1, 0] ** 2 + m[1, 1] ** 2 + m[1, 2] ** 2),
            1 / math.sqrt(m[2, 0] ** 2 + m[2, 1] ** 2 + m[2, 2] ** 2),
        )
        t = trace_foliage(start, direction, half, enter, leave, shapes.density[s], shapes.plant[s], key, leaf_share)
    if shapes.transmission[s] > 0 and hash_uniform(2, key) < shapes.transmission[s]:
        return np.inf
    return t


@njit(cache=True, nogil=True, error_model="numpy")
def shade_hit(shapes, s, direction, since, lift, number):
    """Return the brightness of a ray that ends on solid s, and the cosine of its angle of incidence."""
    reflectance = shapes.reflectance[s]
    if shapes.density[s] < np.inf:
        # Leaves face all directions. The scatter is that of neighbouring points in SemanticKITTI.
        scatter = hash_uniform(6, shapes.salt[s] + np.uint64(number))
        return compute_brightness(reflectance, 0.5) * (0.5 + scatter), 1.0
    start, along = to_unit_frame(shapes, s, direction, since, lift)
    enter, _ = intersect_shape(shapes.kind[s], start, along)
    x, y, z = _normal(
        shapes.kind[s], start[0] + enter * along[0], start[1] + enter * along[1], start[2] + enter * along[2]
    )
    m = shapes.matrix[s]
    out = (
        m[0, 0] * x + m[1, 0] * y + m[2, 0] * z,
        m[0, 1] * x + m[1, 1] * y + m[2, 1] * z,
        m[0, 2] * x + m[1, 2] * y + m[2, 2] * z,
    )
    cosine = abs(out[0] * direction[0] + out[1] * direction[1] + out[2] * direction[2]) / math.sqrt(
        out[0] ** 2 + out[1] ** 2 + out[2] ** 2
    )
    return compute_brightness(reflectance, cosine), cosine


@njit(cache=True, nogil=True)
def _normal(kind, x, y, z):
    """Return the outward normal of a unit shape at a surface point."""
    if kind == ELLIPSOID:
        return x, y, z
    if kind == CYLINDER:
        return (0.0, 0.0, z) if z * z > x * x + y * y else (x, y, 0.0)
    if abs(x) >= abs(y) and abs(x) >= abs(z):
        return x, 0.0, 0.0
    return (0.0, y, 0.0) if abs(y) >= abs(z) else (0.0, 0.0, z)
