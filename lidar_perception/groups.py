"""Points by cluster, one cluster after the other."""

from __future__ import annotations

import numpy as np


def group_points(xyz: np.ndarray, labels: np.ndarray,
                 wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """points (M, 3) of the clusters `wanted` (K,) of ids, one cluster after the other, and
    start (K + 1,) where each begins."""
    place = np.full(int(labels.max(initial=0)) + 1, -1)
    place[wanted] = np.arange(len(wanted))
    group = place[labels]
    members = np.flatnonzero(group >= 0)
    members = members[np.argsort(group[members], kind="stable")]
    sizes = np.bincount(group[members], minlength=len(wanted))
    return xyz.take(members, axis=0), np.concatenate([[0], np.cumsum(sizes)])
