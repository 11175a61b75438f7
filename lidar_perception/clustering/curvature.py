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
    """Find the points whose surface variation is close to the mean of their neighbours.

    Args:
        xyz: (N, 3) float32, metres, N > 0.
        radii: (N,) radius of each point's neighbourhood, metres.
        limit: maximum difference between the surface variation (0 to 1/3) and the mean.
        max_work: maximum number of distances; beyond it, neighbourhoods are sampled.

    Returns:
        (N,) bool: True for points within the limit.
    """
    cells = sort_into_cells(xyz, float(radii.max()))
    radii2 = radii[cells.order] ** 2
    covariances = _compute_covariances(cells, sample_cells(cells, max_work), radii2)
    eigenvalues = np.linalg.eigvalsh(covariances)
    sums = eigenvalues.sum(axis=1)
    variation = np.divide(np.maximum(eigenvalues[:, 0], 0), sums, out=np.zeros_like(sums), where=sums > 0)
    cells_with_variation = cells._replace(xyz=np.vstack([cells.xyz, variation]))
    means = _average_fourth_row(cells_with_variation, sample_cells(cells_with_variation, max_work), radii2)
    is_consistent = np.empty(len(xyz), bool)
    is_consistent[cells.order] = np.float32(np.abs(variation - means)) <= np.float32(limit)
    return is_consistent


@njit(cache=True, nogil=True)
def _compute_covariances(cells, sample, radii2):
    """Compute the covariance of the points within each point's radius: (N, 3, 3), in cell order."""
    covariances = np.zeros((len(cells.order), 3, 3))
    first_moment, second_moment, offset = np.empty(3), np.empty((3, 3)), np.empty(3)
    for a in range(len(cells.size)):
        neighbours, weight = gather_sample(cells, sample, a)
        for i in range(cells.start[a], cells.start[a + 1]):
            total_weight, first_moment[:], second_moment[:] = 0.0, 0.0, 0.0
            for j in range(len(weight)):
                for axis in range(3):
                    offset[axis] = neighbours[axis, j] - cells.xyz[axis, i]
                if offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2 <= radii2[i]:
                    total_weight += weight[j]
                    for p in range(3):
                        first_moment[p] += weight[j] * offset[p]
                        for q in range(3):
                            second_moment[p, q] += weight[j] * offset[p] * offset[q]
            for p in range(3):
                for q in range(3):
                    covariances[i, p, q] = (
                        second_moment[p, q] - first_moment[p] * first_moment[q] / max(total_weight, 1.0)
                    ) / max(total_weight, 1.0)
    return covariances


@njit(cache=True, nogil=True)
def _average_fourth_row(cells, sample, radii2):
    """Average the fourth row of cells.xyz over the points within each point's radius: (N,)."""
    means = np.zeros(len(cells.order))
    for a in range(len(cells.size)):
        neighbours, weight = gather_sample(cells, sample, a)
        for i in range(cells.start[a], cells.start[a + 1]):
            total_weight, weighted_sum = 0.0, 0.0
            for j in range(len(weight)):
                if (
                    (neighbours[0, j] - cells.xyz[0, i]) ** 2
                    + (neighbours[1, j] - cells.xyz[1, i]) ** 2
                    + (neighbours[2, j] - cells.xyz[2, i]) ** 2
                ) <= radii2[i]:
                    total_weight += weight[j]
                    weighted_sum += weight[j] * neighbours[3, j]
            means[i] = weighted_sum / max(total_weight, 1.0)
    return means
