"""Compiled intersection of one ray with one solid.

A solid is a linearly transformed unit shape: cube, sphere or cylinder. A unit shape is an
intersection of slabs and quadrics (Kay and Kajiya, SIGGRAPH 1986).
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
    """P solids for compiled code. Attributes that are not listed here are those of Solids.

    Attributes:
        matrix: (P, 3, 3) linear map from the sensor's frame to the unit shape.
        offset: (P, 3) origin of the sensor's frame in the frame of the unit shape.
        drift: (P, 3) velocity of the sensor relative to the solid, in the frame of the unit shape.
        plant_seed: (P,) uint64 seed of the leaves.
        salt: (P,) uint64 seed of all other random numbers.
    """

    matrix: np.ndarray
    offset: np.ndarray
    drift: np.ndarray
    kind: np.ndarray
    density: np.ndarray
    transmission: np.ndarray
    reflectance: np.ndarray
    plant_seed: np.ndarray
    owner: np.ndarray
    semantic: np.ndarray
    salt: np.ndarray


def compile_solids(solids: Solids, motion: Motion, salt: np.uint64) -> CompiledSolids:
    """Precompute the transforms of solids for ray casting.

    Args:
        solids: The solids.
        motion: Motion of the sensor.
        salt: Seed of the scan.
    """
    matrix = np.swapaxes(solids.axes, 1, 2) / solids.half_size[:, :, None]
    relative_velocity = np.asarray(motion.velocity, np.float64) - solids.velocity
    # Copied because Numba compiles again for read-only arrays and for other memory layouts.
    density, transmission, reflectance = (
        np.array(part, np.float64) for part in (solids.density, solids.transmission, solids.reflectance)
    )
    return CompiledSolids(
        np.array(matrix, order="C"),
        -np.einsum("pij,pj->pi", matrix, solids.centre),
        np.einsum("pij,pj->pi", matrix, relative_velocity),
        np.array(solids.kind),
        density,
        transmission,
        reflectance,
        reflectance.view(np.uint64),  # seed of the part: random per part, constant during a drive
        np.array(solids.owner),
        np.array(solids.semantic),
        (np.arange(len(solids), dtype=np.uint64) << np.uint64(32)) + salt,
    )


@njit(cache=True, nogil=True)
def to_unit_frame(shapes, s, direction, time, lift):
    """Transform a ray from the sensor's frame to the frame of a unit shape.

    Args:
        shapes: CompiledSolids.
        s: Index of the solid.
        direction: Direction (x, y, z) of the ray in the sensor's frame.
        time: Time of the ray relative to the stamp, s.
        lift: Start of the ray on the z axis, m.

    Returns:
        Start (x, y, z) and direction (x, y, z).
    """
    m, o, v = shapes.matrix[s], shapes.offset[s], shapes.drift[s]
    start = (
        o[0] + m[0, 2] * lift + v[0] * time,
        o[1] + m[1, 2] * lift + v[1] * time,
        o[2] + m[2, 2] * lift + v[2] * time,
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

    A ray exactly along the axis of a cylinder or in a face of a box counts as a miss.
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
        if kind == CYLINDER:  # only the distance from the axis matters
            z, w = 0.0, 0.0
        norm_sq = u * u + v * v + w * w
        midpoint = -(x * u + y * v + z * w) / norm_sq
        x, y, z = x + midpoint * u, y + midpoint * v, z + midpoint * w
        half_chord = (1 - (x * x + y * y + z * z)) / norm_sq
        if not half_chord >= 0:
            return np.inf, -np.inf
        half_chord = math.sqrt(half_chord)
        enter, leave = max(enter, midpoint - half_chord), min(leave, midpoint + half_chord)
    return enter, leave


@njit(cache=True, nogil=True, error_model="numpy")
def find_stop_range(shapes, s, start, direction, enter, leave, ray, leaf_fraction):
    """Return the range at which a solid stops a ray, inf if the ray passes through its leaves or glass.

    A ray that starts inside an opaque solid is not stopped.

    Args:
        shapes: CompiledSolids.
        s: Index of the solid.
        start, direction: Ray in the frame of the unit shape, (x, y, z) each.
        enter, leave: Ranges at which the ray enters and leaves the shape, m.
        ray: Index of the ray, which selects its random numbers.
        leaf_fraction: See foliage.py.
    """
    t = enter if enter > 0 else np.inf
    key = shapes.salt[s] + np.uint64(ray)
    if shapes.density[s] < np.inf:
        m = shapes.matrix[s]
        half_size = (
            1 / math.sqrt(m[0, 0] ** 2 + m[0, 1] ** 2 + m[0, 2] ** 2),
            1 / math.sqrt(m[1, 0] ** 2 + m[1, 1] ** 2 + m[1, 2] ** 2),
            1 / math.sqrt(m[2, 0] ** 2 + m[2, 1] ** 2 + m[2, 2] ** 2),
        )
        t = trace_foliage(
            start, direction, half_size, enter, leave, shapes.density[s], shapes.plant_seed[s], key, leaf_fraction
        )
    if shapes.transmission[s] > 0 and hash_uniform(2, key) < shapes.transmission[s]:
        return np.inf
    return t


@njit(cache=True, nogil=True, error_model="numpy")
def shade_hit(shapes, s, direction, time, lift, ray):
    """Return the brightness of a hit on solid s, and the cosine of the angle of incidence.

    See to_unit_frame and find_stop_range for the arguments.
    """
    reflectance = shapes.reflectance[s]
    if shapes.density[s] < np.inf:
        # Leaves face all directions. The scatter is as between neighbouring points in SemanticKITTI.
        scatter = hash_uniform(6, shapes.salt[s] + np.uint64(ray))
        return compute_brightness(reflectance, 0.5) * (0.5 + scatter), 1.0
    start, unit_direction = to_unit_frame(shapes, s, direction, time, lift)
    enter, _ = intersect_shape(shapes.kind[s], start, unit_direction)
    x, y, z = _compute_normal(
        shapes.kind[s],
        start[0] + enter * unit_direction[0],
        start[1] + enter * unit_direction[1],
        start[2] + enter * unit_direction[2],
    )
    m = shapes.matrix[s]
    normal = (
        m[0, 0] * x + m[1, 0] * y + m[2, 0] * z,
        m[0, 1] * x + m[1, 1] * y + m[2, 1] * z,
        m[0, 2] * x + m[1, 2] * y + m[2, 2] * z,
    )
    cosine = abs(normal[0] * direction[0] + normal[1] * direction[1] + normal[2] * direction[2]) / math.sqrt(
        normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2
    )
    return compute_brightness(reflectance, cosine), cosine


@njit(cache=True, nogil=True)
def _compute_normal(kind, x, y, z):
    """Return the outward normal of a unit shape at a surface point."""
    if kind == ELLIPSOID:
        return x, y, z
    if kind == CYLINDER:
        return (0.0, 0.0, z) if z * z > x * x + y * y else (x, y, 0.0)
    if abs(x) >= abs(y) and abs(x) >= abs(z):
        return x, 0.0, 0.0
    return (0.0, y, 0.0) if abs(y) >= abs(z) else (0.0, 0.0, z)
