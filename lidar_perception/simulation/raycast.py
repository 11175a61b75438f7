"""First hits of all rays of one revolution of the sensor, compiled.

Solids are rasterised into a depth buffer of firings and beams, each into its window (windows.py).
Unlabelled solids come last, from near to far, since most of their rays are then hidden. The ground,
which takes longest, is intersected only where it may be nearer. Rays at the edges of solids are cast
a second time, into the footprint of the beam, see edges.py.

Solids are in the sensor's frame at the stamp. The ground is in the world frame, relative to which the
sensor's frame is rotated only about z.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from lidar_perception.simulation import foliage
from lidar_perception.simulation.edges import RayHit, draw_in_footprint, find_edges, merge_hits
from lidar_perception.simulation.hashing import mix_bits
from lidar_perception.simulation.intersection import (
    compile_solids,
    find_stop_range,
    intersect_shape,
    shade_hit,
    to_unit_frame,
)
from lidar_perception.simulation.sensor import NO_MOTION, Motion, Sensor, make_rays
from lidar_perception.simulation.solids import Solids
from lidar_perception.simulation.terrain import Ground, cast_ground, min_ground_range, to_compiled
from lidar_perception.simulation.windows import find_windows


class Hits(NamedTuple):
    """First hits without noise, as (columns, rings) arrays.

    Attributes:
        range: float64 m; inf without a hit, 0 if the ray starts in a tuft of grass.
        brightness: float64, 0..1.
        cosine: float64 cosine of the angle of incidence, 0 without a hit.
        owner: int32 track id of the object, 0 for none.
        semantic: uint16 class; 0 without a hit, 1 (outlier) between two surfaces, see edges.py.
        solid: int32 index of the solid, -1 for none.
        reached: (objects + 1,) int64, number of rays that would hit each object if it were alone.
    """

    range: np.ndarray
    brightness: np.ndarray
    cosine: np.ndarray
    owner: np.ndarray
    semantic: np.ndarray
    solid: np.ndarray
    reached: np.ndarray


class Turn(NamedTuple):
    """Rays of one revolution, for compiled code.

    Attributes:
        direction: (columns, rings, 3) unit vectors in the sensor's frame at the stamp.
        since: (columns,) time after the stamp, s.
        lift: (rings,) start of each beam on the z axis, m.
    """

    direction: np.ndarray
    since: np.ndarray
    lift: np.ndarray


def cast_rays(
    solids: Solids,
    ground: Ground,
    position: np.ndarray,
    sensor: Sensor,
    motion: Motion = NO_MOTION,
    seed: int = 0,
    heading: float = 0.0,
) -> Hits:
    """Cast all rays of one revolution of a sensor.

    Args:
        solids: Solids in the sensor's frame at the stamp.
        ground: The ground.
        position: (3,) position of the sensor in the world at the stamp, m.
        sensor: The sensor.
        motion: Motion of the sensor in its own frame.
        seed: Seed of foliage, glass and edges; its lowest 64 bits are used.
        heading: Heading of the sensor in the world, rad.
    """
    salt = np.uint64(mix_bits(np.uint64(seed % (1 << 64))))
    rays = make_rays(sensor, motion)
    turn = Turn(rays.direction, rays.since, sensor.origins()[:, 2].copy())
    windows = find_windows(solids, sensor, motion, sensor.divergence / 2)
    scene = (
        compile_solids(solids, motion, salt),
        windows,
        np.lexsort((windows.min_range, solids.owner, solids.owner == 0)),
        to_compiled(ground),
        np.array(position, np.float64),
        np.array(motion.velocity, np.float64),
        (math.cos(heading), math.sin(heading)),
        float(sensor.max_range),
        foliage.LEAF_SHARE,
    )
    shape = (sensor.columns, sensor.rings)
    hits = Hits(
        np.empty(shape),
        np.empty(shape),
        np.empty(shape),
        np.empty(shape, np.int32),
        np.empty(shape, np.uint16),
        np.empty(shape, np.int32),
        np.zeros(int(solids.owner.max(initial=0)) + 1, np.int64),
    )
    _cast_first(hits, turn, np.ones(shape, bool), *scene, True)
    if sensor.divergence:
        edge, other = find_edges(hits.solid), Hits(*(np.empty_like(grid) for grid in hits))
        _turn_into_footprints(turn.direction, edge, float(sensor.divergence), salt)
        _cast_first(other, turn, edge, *scene, False)
        _merge_edges(hits, other, edge, float(sensor.pulse), salt)
    return hits


@njit(cache=True, nogil=True)
def _cast_first(
    hits, turn, mask, shapes, windows, order, ground, position, velocity, facing, max_range, leaf_share, counting
):
    """Fill the hits of the rays in the mask (columns, rings), and hits.reached if counting.

    order: indices of the solids, first by owner, then those without an owner from near to far.
    """
    hits.range[:] = np.inf
    hits.solid[:] = -1
    _draw_solids(hits, turn, mask, shapes, windows, order, max_range, leaf_share, counting)
    columns, rings = mask.shape
    for column in range(columns):
        since = turn.since[column]
        along, aside, up = _to_world(velocity, facing)
        x, y, z = position[0] + along * since, position[1] + aside * since, position[2] + up * since
        for ring in range(rings):
            if mask[column, ring]:
                direction = _get_direction(turn, column, ring)
                start, down = (x, y, z + turn.lift[ring]), _to_world(direction, facing)
                far, s = hits.range[column, ring], hits.solid[column, ring]
                if not far < min_ground_range(ground, start, down):
                    hit = cast_ground(ground, start, down, max_range)
                    if s < 0 or np.float32(hit.range) < np.float32(far):
                        _write_hit(
                            hits, column, ring, RayHit(hit.range, hit.brightness, hit.cosine, 0, hit.semantic, -1)
                        )
                        continue
                if s >= 0:
                    brightness, cosine = shade_hit(
                        shapes, s, direction, since, turn.lift[ring], ring * columns + column
                    )
                    _write_hit(
                        hits, column, ring, RayHit(far, brightness, cosine, shapes.owner[s], shapes.semantic[s], s)
                    )
                else:
                    _write_hit(hits, column, ring, RayHit(np.inf, 0.0, 0.0, 0, 0, -1))


@njit(cache=True, nogil=True)
def _to_world(vector, facing):
    """Rotate a vector (x, y, z) from the sensor's frame to the world; facing: cos and sin of the heading."""
    cos, sin = facing
    return cos * vector[0] - sin * vector[1], sin * vector[0] + cos * vector[1], vector[2]


@njit(cache=True, nogil=True)
def _get_direction(turn, column, ring):
    x, y, z = turn.direction[column, ring]
    return x, y, z


@njit(cache=True, nogil=True)
def _draw_solids(hits, turn, mask, shapes, windows, order, max_range, leaf_share, counting):
    columns, rings = mask.shape
    latest = np.zeros((columns, rings), np.int32)  # last owner hit by each ray
    for s in order:
        owner, near = shapes.owner[s], windows.min_range[s]
        counts = counting and owner > 0
        highest, lowest = 0, rings
        while lowest > 0 and not windows.beams[s, lowest - 1]:
            lowest -= 1
        while highest < lowest and not windows.beams[s, highest]:
            highest += 1
        for step in range(windows.count[s] if highest < lowest else 0):
            column = (windows.first[s] + step) % columns
            for ring in range(highest, lowest):
                if not windows.beams[s, ring] or not mask[column, ring]:
                    continue
                far = hits.range[column, ring]
                if near > far and not counts:
                    continue
                start, direction = to_unit_frame(
                    shapes, s, _get_direction(turn, column, ring), turn.since[column], turn.lift[ring]
                )
                enter, leave = intersect_shape(shapes.kind[s], start, direction)
                if not (enter <= leave and leave > 0) or (np.float32(enter) > np.float32(far) and not counts):
                    continue
                t = find_stop_range(shapes, s, start, direction, enter, leave, ring * columns + column, leaf_share)
                if not t < leave or t > max_range:
                    continue
                if counts and latest[column, ring] != owner:
                    latest[column, ring] = owner
                    hits.reached[owner] += 1
                # If hits are equal in float32, the solid with the lower index wins, in any order.
                t32, far32, before = np.float32(t), np.float32(far), hits.solid[column, ring]
                if t32 < far32 or (t32 == far32 and (before < 0 or s < before)):
                    hits.range[column, ring], hits.solid[column, ring] = t, s


@njit(cache=True, nogil=True)
def _turn_into_footprints(direction, mask, divergence, salt):
    """Rotate the rays in the mask to random points in the footprints of their beams."""
    columns, rings = mask.shape
    for column in range(columns):
        for ring in range(rings):
            if mask[column, ring]:
                ray = direction[column, ring]
                ray[0], ray[1], ray[2] = draw_in_footprint(
                    (ray[0], ray[1], ray[2]), divergence, salt + np.uint64(ring * columns + column)
                )


@njit(cache=True, nogil=True)
def _merge_edges(hits, other, mask, pulse, salt):
    """Merge the hits of both rays of the beams in the mask, in place into hits."""
    columns, rings = mask.shape
    for column in range(columns):
        for ring in range(rings):
            if mask[column, ring]:
                _write_hit(
                    hits,
                    column,
                    ring,
                    merge_hits(
                        _read_hit(hits, column, ring),
                        _read_hit(other, column, ring),
                        pulse,
                        salt + np.uint64(ring * columns + column),
                    ),
                )


@njit(cache=True, nogil=True)
def _read_hit(hits, column, ring):
    return RayHit(
        hits.range[column, ring],
        hits.brightness[column, ring],
        hits.cosine[column, ring],
        np.int64(hits.owner[column, ring]),
        np.int64(hits.semantic[column, ring]),
        np.int64(hits.solid[column, ring]),
    )


@njit(cache=True, nogil=True)
def _write_hit(hits, column, ring, hit):
    hits.range[column, ring] = hit.range
    hits.brightness[column, ring] = hit.brightness
    hits.cosine[column, ring] = hit.cosine
    hits.owner[column, ring] = hit.owner
    hits.semantic[column, ring] = hit.semantic
    hits.solid[column, ring] = hit.solid
