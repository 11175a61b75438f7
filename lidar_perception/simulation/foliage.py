"""Rays through foliage: clumps of leaves with gaps between them."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lidar_perception.simulation.hashing import hash_uniform, mix_bits

# Size of the cells, and fraction of the cells that contain leaves. The gaps split a crown into several
# DBSCAN clusters, as in KITTI.
CELL_M, LEAF_FRACTION = 0.5, 0.25
MAX_STEPS = 12  # steps after which a ray leaves the foliage


@njit(cache=True, nogil=True)
def trace_foliage(origin, direction, half_size, enter, leave, density, plant_seed, key, leaf_fraction):
    """Return the range in metres at which leaves stop a ray, inf if none do.

    Delta tracking (Woodcock et al. 1965) through a grid of full and empty cells.

    Args:
        origin, direction: Ray in the frame of a unit shape, (x, y, z) each.
        half_size: Half sizes of the shape, m.
        enter, leave: Ranges at which the ray enters and leaves the shape, m.
        density: Mean density, 1/m.
        plant_seed: uint64 seed of the plant, constant during a drive.
        key: uint64 key of the random numbers of this ray and plant.
        leaf_fraction: Fraction of the cells that contain leaves.
    """
    t = max(enter, 0.0)
    for step in range(MAX_STEPS):
        t -= math.log(hash_uniform(10 + step, key)) * leaf_fraction / density
        if not t < leave:
            return np.inf
        cell_hash = plant_seed
        for i in range(3):
            index = math.floor((origin[i] + t * direction[i]) * (half_size[i] / CELL_M))
            cell_hash = mix_bits(cell_hash + np.uint64(np.int64(index)))
        if hash_uniform(1, cell_hash) < leaf_fraction:
            return t
    return np.inf
