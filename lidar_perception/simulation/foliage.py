"""Rays through foliage: clumps of leaves with gaps between them."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lidar_perception.simulation.hashing import hash_uniform, mix_bits

# Size of the cells, and share of the cells that contain leaves. The gaps split a crown into several
# DBSCAN clusters, as in KITTI.
CELL_M, LEAF_SHARE = 0.5, 0.25
MAX_STEPS = 12  # maximum steps of a ray through foliage, after which it passes


@njit(cache=True, nogil=True)
def trace_foliage(origin, direction, half, enter, leave, density, plant, key, leaf_share):
    """Return the range in metres at which leaves stop a ray, inf if it passes.

    Delta tracking (Woodcock et al. 1965) through a grid of full and empty cells.

    Args:
        origin, direction: Ray in the frame of a unit shape, (x, y, z) each.
        half: Half sizes of the shape, m.
        enter, leave: Ranges at which the ray enters and leaves the shape, m.
        density: Mean density, 1/m.
        plant: uint64, equal for all rays to one plant in a drive.
        key: uint64 key of the random numbers of this ray and plant.
        leaf_share: Share of the cells that contain leaves.
    """
    t = max(enter, 0.0)
    for step in range(MAX_STEPS):
        t -= math.log(hash_uniform(10 + step, key)) * leaf_share / density
        if not t < leave:
            return np.inf
        cell = plant
        for i in range(3):
            index = math.floor((origin[i] + t * direction[i]) * (half[i] / CELL_M))
            cell = mix_bits(cell + np.uint64(np.int64(index)))
        if hash_uniform(1, cell) < leaf_share:
            return t
    return np.inf
