"""Beams through leaves, which grow in clumps with gaps between them."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lidar_perception.simulation.hashing import hash_uniform, mix_bits

# Width of cells, and the fraction of them that holds all leaves. With leaves everywhere a crown would
# be one cluster for DBSCAN; KITTI's crowns fall into many. A beam that hits no leaf within
# MAX_STEPS passes.
CELL_M, LEAF_SHARE, MAX_STEPS = 0.5, 0.25, 12


@njit(cache=True, nogil=True)
def trace_foliage(start, way, half, enter, leave, density, plant, key, filled):
    """Return the range in metres at which leaves stop a ray, inf if it passes.

    Delta tracking (Woodcock et al., 1965) through a grid of full and empty cells.

    Args:
        start, way: Ray in the frame of a unit shape, three numbers each.
        half: Half sizes of the shape, m.
        enter, leave: Ranges at which the ray enters and leaves the shape, m.
        density: Mean density, 1/m.
        plant: uint64, equal for all rays to a plant in a drive.
        key: uint64, for the random numbers of this ray and plant.
        filled: Share of the cells that hold leaves.
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
