"""Roughness of the ground: scatter of its points about planes fitted to small cells."""

from __future__ import annotations

import numpy as np

CELL = 1.0  # cell size in metres
MIN_IN_CELL = 8  # minimum number of points in a cell
MIN_GROUND = 0.6  # minimum fraction of low points in a ground cell
LOW_SHARE, MAX_ABOVE_LOW = 0.2, 0.35  # low points: at most 0.35 m above this quantile of the cell
MIN_CELLS = 20  # minimum number of cells in a range bin to measure its roughness
ROUGH_QUANTILE = 0.75  # high, because most cells are on the smooth road
REGULARIZATION = 1e-6  # in m2, added to the scatter along x and y so that a plane fits even collinear points


def measure_cell_scatter(xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit planes to the square cells of a cloud (N, 3) that are mostly ground.

    Returns:
        The mean x and y of the points of each cell (C, 2), and the standard deviation of the points
        about the plane (C,), metres. C may be 0.
    """
    cells = np.floor(xyz[:, :2] / CELL).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    order = np.lexsort((xyz[:, 2], cell))
    points, cell = xyz[order].astype(np.float64), cell[order]
    count = np.bincount(cell)
    first = np.cumsum(count) - count
    low = points[first + (LOW_SHARE * (count - 1)).astype(int), 2]
    near = points[:, 2] < low[cell] + MAX_ABOVE_LOW
    left = np.bincount(cell[near], minlength=len(count))
    kept = (left >= MIN_IN_CELL) & (left >= MIN_GROUND * count)
    points, cell = points[near & kept[cell]], cell[near & kept[cell]]
    left = left[kept]
    number = (np.cumsum(kept) - 1)[cell]

    def mean(values: np.ndarray) -> np.ndarray:
        return np.bincount(number, values, minlength=len(left)) / left

    middle = np.stack([mean(column) for column in points.T], axis=1).reshape(-1, 3)
    x, y, z = (points - middle[number]).T
    across = np.moveaxis(
        np.array([[mean(x * x) + REGULARIZATION, mean(x * y)], [mean(x * y), mean(y * y) + REGULARIZATION]]), 2, 0
    )
    slopes = np.linalg.solve(across, np.stack([mean(x * z), mean(y * z)], axis=1)[..., None])
    off = z - x * slopes[number, 0, 0] - y * slopes[number, 1, 0]
    return middle[:, :2], np.sqrt(mean(off * off))


def compute_roughness(xyz: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Return the ROUGH_QUANTILE of the scatter of the cells in each range bin (B,), metres.

    limits (B + 1,) are the limits of the bins, metres. NaN for bins with fewer than MIN_CELLS.
    """
    middle, scatter = measure_cell_scatter(xyz)
    where = np.searchsorted(limits, np.hypot(*middle.T), side="right") - 1
    row = np.full(len(limits) - 1, np.nan)
    for i in range(len(row)):
        if (where == i).sum() >= MIN_CELLS:
            row[i] = np.quantile(scatter[where == i], ROUGH_QUANTILE)
    return row
