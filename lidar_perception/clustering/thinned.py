"""One point for many that nearly coincide, where pairs of points would take too long.

Which sets of points have a pair within reach cannot be had exactly in n log n in 3D (Gan and Tao,
"DBSCAN Revisited", SIGMOD 2015): whoever puts half of a cloud on one place and the other half on a
sphere around it, a hair out of reach, makes every exact method look at all pairs. So each search
has a patience; beyond it, one point of each cube of a COARSE-th of the reach stands for the others,
with a reach that is longer by SLACK. What is connected stays connected; what is farther apart than
the reach, but by less than SLACK of it, may be connected too.
"""

from __future__ import annotations

import numpy as np

COARSE = 32                    # cubes along a reach
SLACK = 2 * 3**0.5 / COARSE    # share of the reach; a point is within a diagonal of the one kept
PATIENCE = 2_000               # distances a point
ENOUGH = 2**30                 # or so many in all, about a second


def patience(count: int) -> float:
    """Distances that an exact search of so many points may take."""
    return float(max(PATIENCE * count, ENOUGH))


def thinned(xyz: np.ndarray, reach: np.ndarray | float,
            kind: np.ndarray | int = 0) -> tuple[np.ndarray, np.ndarray]:
    """kept (K,): indices of one of points (N, 3) of each cube and kind (N,) int; and group (N,),
    which of them, 0..K-1, each point belongs to. Cubes are as large as the reach of the points in
    them says, (N,) or for all, by powers of two."""
    octave = np.floor(np.log2(np.broadcast_to(np.maximum(reach, 1e-6), len(xyz))))
    cubes = np.floor(xyz / (2.0**octave / COARSE)[:, None])
    keys = np.column_stack([cubes, octave, np.broadcast_to(kind, len(xyz))])
    order = np.lexsort(keys.T)
    new = np.r_[True, (keys[order][1:] != keys[order][:-1]).any(axis=1)][:len(order)]
    group = np.empty(len(xyz), np.int64)
    group[order] = np.cumsum(new) - 1
    return order[new], group
