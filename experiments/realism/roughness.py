"""Roughness of the ground, measured by the scatter of points about planes fitted to small cells."""

from __future__ import annotations

import numpy as np

CELL_SIZE_M = 1.0
MIN_CELL_POINTS = 8  # minimum number of low points in a ground cell
MIN_LOW_FRACTION = 0.6  # minimum fraction of low points in a ground cell
LOW_QUANTILE, MAX_LOW_HEIGHT_M = 0.2, 0.35  # low points are at most 0.35 m above this quantile of the cell
MIN_CELLS = 20  # minimum number of cells in a range bin to measure its roughness
ROUGH_QUANTILE = 0.75  # high, because most cells are on the smooth road
REGULARIZATION_M2 = 1e-6  # added to the variance along x and y, so that a plane fits even collinear points


def measure_cell_scatter(xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit planes to the square cells of a cloud (N, 3) that are mostly ground.

    Returns:
        The mean x and y of the low points of each cell (C, 2), and their standard deviation about
        the plane (C,), metres. C may be 0.
    """
    cell_indices = np.floor(xyz[:, :2] / CELL_SIZE_M).astype(np.int64)
    _, cell = np.unique(cell_indices, axis=0, return_inverse=True)
    order = np.lexsort((xyz[:, 2], cell))
    points, cell = xyz[order].astype(np.float64), cell[order]
    counts = np.bincount(cell)
    first = np.cumsum(counts) - counts
    low_heights = points[first + (LOW_QUANTILE * (counts - 1)).astype(int), 2]
    is_low = points[:, 2] < low_heights[cell] + MAX_LOW_HEIGHT_M
    low_counts = np.bincount(cell[is_low], minlength=len(counts))
    is_ground_cell = (low_counts >= MIN_CELL_POINTS) & (low_counts >= MIN_LOW_FRACTION * counts)
    is_used = is_low & is_ground_cell[cell]
    points, cell = points[is_used], cell[is_used]
    low_counts = low_counts[is_ground_cell]
    number = (np.cumsum(is_ground_cell) - 1)[cell]

    def compute_means(values: np.ndarray) -> np.ndarray:
        return np.bincount(number, values, minlength=len(low_counts)) / low_counts

    centres = np.stack([compute_means(column) for column in points.T], axis=1).reshape(-1, 3)
    x, y, z = (points - centres[number]).T
    xx, xy, yy = compute_means(x * x), compute_means(x * y), compute_means(y * y)
    covariance = np.moveaxis(np.array([[xx + REGULARIZATION_M2, xy], [xy, yy + REGULARIZATION_M2]]), 2, 0)
    slopes = np.linalg.solve(covariance, np.stack([compute_means(x * z), compute_means(y * z)], axis=1)[..., None])
    residuals = z - x * slopes[number, 0, 0] - y * slopes[number, 1, 0]
    return centres[:, :2], np.sqrt(compute_means(residuals * residuals))


def compute_roughness(xyz: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Return the ROUGH_QUANTILE of the scatter of the cells in each range bin (B,), metres.

    NaN for bins with fewer than MIN_CELLS cells.

    Args:
        xyz: (N, 3) cloud.
        limits: (B + 1,) limits of the range bins, metres.
    """
    centres, scatter = measure_cell_scatter(xyz)
    bin_indices = np.searchsorted(limits, np.hypot(*centres.T), side="right") - 1
    row = np.full(len(limits) - 1, np.nan)
    for i in range(len(row)):
        if (bin_indices == i).sum() >= MIN_CELLS:
            row[i] = np.quantile(scatter[bin_indices == i], ROUGH_QUANTILE)
    return row
