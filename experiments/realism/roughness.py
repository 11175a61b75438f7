"""How rough the ground of a scan is: how its points scatter about planes of small cells."""

from __future__ import annotations

import numpy as np

CELL = 1.0            # m
MIN_IN_CELL = 8     # points
MIN_GROUND = 0.6    # share of the points of a cell that must be low for it to be ground
DEEPEST, HIGHEST = 0.2, 0.35  # this share of a cell may be lower; low is up to so many m above
MIN_CELLS = 20      # of a range whose roughness is told
UPPER = 0.75          # of the cells; most are of the road, which is smooth
EVEN = 1e-6           # m2, added to the scatter along x and y: a line of points has a plane, too


def scatter_of_cells(xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the cells of CELL on a side that are mostly ground, the middle of their points (C, 2) and
    the standard deviation of these about their plane (C,), metres. xyz (N, 3); C may be 0."""
    cells = np.floor(xyz[:, :2] / CELL).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    order = np.lexsort((xyz[:, 2], cell))
    points, cell = xyz[order].astype(np.float64), cell[order]
    count = np.bincount(cell)
    first = np.cumsum(count) - count
    low = points[first + (DEEPEST * (count - 1)).astype(int), 2]
    near = points[:, 2] < low[cell] + HIGHEST
    left = np.bincount(cell[near], minlength=len(count))
    kept = (left >= MIN_IN_CELL) & (left >= MIN_GROUND * count)
    points, cell = points[near & kept[cell]], cell[near & kept[cell]]
    left = left[kept]
    number = (np.cumsum(kept) - 1)[cell]

    def mean(values: np.ndarray) -> np.ndarray:
        return np.bincount(number, values, minlength=len(left)) / left

    middle = np.stack([mean(column) for column in points.T], axis=1).reshape(-1, 3)
    x, y, z = (points - middle[number]).T
    across = np.moveaxis(np.array([[mean(x * x) + EVEN, mean(x * y)],
                                   [mean(x * y), mean(y * y) + EVEN]]), 2, 0)
    slopes = np.linalg.solve(across, np.stack([mean(x * z), mean(y * z)], axis=1)[..., None])
    off = z - x * slopes[number, 0, 0] - y * slopes[number, 1, 0]
    return middle[:, :2], np.sqrt(mean(off * off))


def roughness(xyz: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """(B,) UPPER quantile of the scatter of the cells in each range from limits (B + 1,) metres;
    NaN where there are fewer than MIN_CELLS."""
    middle, scatter = scatter_of_cells(xyz)
    where = np.searchsorted(limits, np.hypot(*middle.T), side="right") - 1
    row = np.full(len(limits) - 1, np.nan)
    for i in range(len(row)):
        if (where == i).sum() >= MIN_CELLS:
            row[i] = np.quantile(scatter[where == i], UPPER)
    return row
