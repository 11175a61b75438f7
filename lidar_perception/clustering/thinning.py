"""Thinning of nearly coincident points, for clouds where comparing all pairs takes too long.

No exact method finds the sets of points within reach of each other in O(n log n) in 3D (Gan and
Tao, "DBSCAN Revisited", SIGMOD 2015). With half of a cloud at one place and the other half on a
sphere around it, slightly out of reach, every exact method compares all pairs. Each search
therefore has a limit. Beyond it, one point represents all points of a cube whose side is the reach
divided by CUBES_PER_REACH, and the reach is longer by SLACK. Connected points stay connected;
points that are farther apart than the reach by less than SLACK may be connected too.
"""

from __future__ import annotations

import numpy as np

CUBES_PER_REACH = 32
# Fraction of the reach: each point of a pair may be a cube's diagonal away from its representative.
SLACK = 2 * 3**0.5 / CUBES_PER_REACH
MAX_DISTANCES_PER_POINT = 2_000  # maximum number of distances of an exact search, per point
MIN_DISTANCES = 2**30  # lower limit of that maximum in distances per cloud; they take about a second


def compute_max_exact_distances(count: int) -> float:
    """Return the maximum number of distances for an exact search of `count` points."""
    return float(max(MAX_DISTANCES_PER_POINT * count, MIN_DISTANCES))


def thin_points(
    xyz: np.ndarray, reach: np.ndarray | float, kind: np.ndarray | int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Keep one point per cube and kind.

    Args:
        xyz: (N, 3) points in metres.
        reach: (N,) reach of each point in metres, or one for all. Rounded down to a power of two,
            it determines the size of the point's cube.
        kind: (N,) int, or one for all; points of different kinds are never merged.

    Returns:
        kept (K,), the indices of the points that are kept; group (N,), the index into `kept` of the
        point that represents each point.
    """
    octave = np.floor(np.log2(np.broadcast_to(np.maximum(reach, 1e-6), len(xyz))))
    cubes = np.floor(xyz / (2.0**octave / CUBES_PER_REACH)[:, None])
    keys = np.column_stack([cubes, octave, np.broadcast_to(kind, len(xyz))])
    order = np.lexsort(keys.T)
    is_first = np.r_[True, (keys[order][1:] != keys[order][:-1]).any(axis=1)][: len(order)]
    group = np.empty(len(xyz), np.int64)
    group[order] = np.cumsum(is_first) - 1
    return order[is_first], group
