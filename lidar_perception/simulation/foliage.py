"""Beams through leaves, which hang in clumps with gaps between them."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lidar_perception.simulation.hashing import hash_uniform, mix_bits

# Cells so many metres wide, of which this share holds all the leaves. With leaves everywhere a
# crown is one cluster for DBSCAN; KITTI's fall into many. STEPS: within so many either a leaf is
# met or the beam is taken to pass.
CELL_M, LEAF_SHARE, MAX_STEPS = 0.5, 0.25, 12


@njit(cache=True, nogil=True)
def trace_foliage(start, way, half, enter, leave, density, plant, key, filled):
    """Range in metres at which leaves stop a ray, inf where it passes: delta tracking (Woodcock et
    al., 1965) through a grid of full and empty cells.

    start, way: three numbers each, the ray in the frame of a unit shape; half: the half sizes of
    that, m; enter, leave: ranges, m; density: mean, 1/m; plant: uint64, the same for all rays of a
    plant and all along a drive; key: uint64, of the random numbers of this ray and plant; filled:
    share of the cells that hold leaves.
    """
    t = max(enter, 0.0)
    for step in range(MAX_STEPS):
        t -= math.log(hash_uniform(10 + step, key)) * filled / density
        if not t < leave:
            return np.inf
        cell = plant
        for i in range(3):
            place = math.floor((start[i] + t * way[i]) * (half[i] / CELL_M))
            cell = mix_bits(cell + np.uint64(np.int64(place)))
        if hash_uniform(1, cell) < filled:
            return t
    return np.inf
