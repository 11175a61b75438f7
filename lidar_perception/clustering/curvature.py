"""Curvature-consistent growing, an option of the adaptive Euclidean clustering.

The introduction of paper C names "curvature-consistency-based region growing" and does not specify
it. This is our reading: a cluster grows only from points on a surface whose curvature changes
little. Such a point's surface variation (Pauly et al., IEEE Visualization 2002), the smallest
eigenvalue of the covariance of its neighbours divided by the sum of all three, differs little from
the mean of its neighbours. Other points join the cluster of a point that reaches them.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lidar_perception.clustering.cells import gather_sample, sample_cells, sort_into_cells


def find_consistent_points(xyz: np.ndarray, radii: np.ndarray, limit: float, max_work: int) -> np.ndarray:
    """Find the points whose surface variation is within `limit` of the mean around them.

    Args:
        xyz: (N, 3) float32, metres, N > 0.
        radii: (N,) radius of each point's neighbourhood, metres.
        limit: 0..1/3, as the surface variation.
        max_work: distances to compute; beyond it, neighbourhoods are sampled.

    Returns:
        (N,) bool.
    """
    cells = sort_into_cells(xyz, float(radii.max()))
    radii2 = radii[cells.order] ** 2
    covariances = _compute_covariances(cells, sample_cells(cells, max_work), radii2)
    values = np.linalg.eigvalsh(covariances)
    sums = values.sum(axis=1)
    variation = np.divide(np.maximum(values[:, 0], 0), sums, out=np.zeros_like(sums), where=sums > 0)
    carrying = cells._replace(xyz=np.vstack([cells.xyz, variation]))
    means = _average_around(carrying, sample_cells(carrying, max_work), radii2)
    consistent = np.empty(len(xyz), bool)
    consistent[cells.order] = np.float32(np.abs(variation - means)) <= np.float32(limit)
    return consistent


@njit(cache=True, nogil=True)
def _compute_covariances(cells, sample, radii2):
    """Return (N, 3, 3) covariances of the points within each point's radius, in cell order."""
    out = np.zeros((len(cells.order), 3, 3))
    first, second, offset = np.empty(3), np.empty((3, 3)), np.empty(3)
    for a in range(len(cells.size)):
        near, weight = gather_sample(cells, sample, a)
        for i in range(cells.start[a], cells.start[a + 1]):
            total, first[:], second[:] = 0.0, 0.0, 0.0
            for j in range(len(weight)):
                for axis in range(3):
                    offset[axis] = near[axis, j] - cells.xyz[axis, i]
                if offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2 <= radii2[i]:
                    total += weight[j]
                    for p in range(3):
                        first[p] += weight[j] * offset[p]
                        for q in range(3):
                            second[p, q] += weight[j] * offset[p] * offset[q]
            for p in range(3):
                for q in range(3):
                    out[i, p, q] = (second[p, q] - first[p] * first[q] / max(total, 1.0)) / max(total, 1.0)
    return out


@njit(cache=True, nogil=True)
def _average_around(cells, sample, radii2):
    """Return (N,) means of the fourth row of the points within each point's radius."""
    means = np.zeros(len(cells.order))
    for a in range(len(cells.size)):
        near, weight = gather_sample(cells, sample, a)
        for i in range(cells.start[a], cells.start[a + 1]):
            total, value = 0.0, 0.0
            for j in range(len(weight)):
                if (
                    (near[0, j] - cells.xyz[0, i]) ** 2
                    + (near[1, j] - cells.xyz[1, i]) ** 2
                    + (near[2, j] - cells.xyz[2, i]) ** 2
                ) <= radii2[i]:
                    total += weight[j]
                    value += weight[j] * near[3, j]
            means[i] = value / max(total, 1.0)
    return means
