"""Smooth surface through the ground points of a cloud."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from scipy import ndimage

CELL_M = 2.0  # width of the square cells whose mean heights define the surface
MIN_POINTS = 3  # minimum number of ground points for a cell to have a height
SMOOTHING_M = 2.4  # standard deviation of the Gaussian that smooths the heights
MIN_WEIGHT = 1e-3  # minimum weight of a smoothed height; other cells get the height of the nearest cell


class GroundSurface(NamedTuple):
    """Heights of the ground on a grid, linear between the centres of its cells and constant beyond.

    Attributes:
        heights: (I, J) float64 z at the centres of the cells, in metres.
        first: x and y of the centre of cell (0, 0), in metres.
    """

    heights: np.ndarray
    first: tuple[float, float]

    def height_at(self, xy: np.ndarray) -> np.ndarray:
        """Return the height (K,) float64 of the ground at positions (K, 2 or more) [x y ...]."""
        return _interpolate(self.heights, np.asarray(xy), *self.first)


def fit_ground_surface(ground: np.ndarray, default: float) -> GroundSurface:
    """Fit a surface to ground points (G, 3).

    The mean heights of cells are smoothed. Cells without ground points, for example under cars, get
    the height of the cells around them, or if those have none, of the nearest cell.

    Args:
        ground: finite points of a limited area, because memory grows with the area.
        default: height in metres if no cell has MIN_POINTS points.
    """
    if not len(ground):
        return GroundSurface(np.full((1, 1), default), (0.0, 0.0))
    low, high = (
        np.floor(np.array([reduce(ground[:, 0]), reduce(ground[:, 1])]) / CELL_M) for reduce in (np.min, np.max)
    )  # by column, which is faster than along axis 0
    shape = (high - low).astype(np.int64) + 1
    height_sum, count = _sum_cells(ground, low, shape)
    has_height = count >= MIN_POINTS
    if not has_height.any():
        return GroundSurface(np.full((1, 1), default), (0.0, 0.0))
    mean = np.divide(height_sum, count, out=np.zeros(shape), where=has_height)
    sigma = SMOOTHING_M / CELL_M
    weight = ndimage.gaussian_filter(has_height.astype(np.float64), sigma, mode="constant")
    smoothed_heights = ndimage.gaussian_filter(mean, sigma, mode="constant") / np.maximum(weight, MIN_WEIGHT)
    nearest_cell = ndimage.distance_transform_edt(weight < MIN_WEIGHT, return_distances=False, return_indices=True)
    x, y = (low + 0.5) * CELL_M
    return GroundSurface(smoothed_heights[tuple(nearest_cell)], (float(x), float(y)))


@njit(cache=True, nogil=True)
def _sum_cells(ground, low, shape):
    """Return the sum of the heights and the number of the ground points in each cell."""
    height_sum, count = np.zeros((shape[0], shape[1])), np.zeros((shape[0], shape[1]))
    for k in range(len(ground)):
        i = int(np.floor(ground[k, 0] / CELL_M) - low[0])
        j = int(np.floor(ground[k, 1] / CELL_M) - low[1])
        height_sum[i, j] += ground[k, 2]
        count[i, j] += 1.0
    return height_sum, count


@njit(cache=True, nogil=True)
def _interpolate(heights, xy, first_x, first_y):
    result = np.empty(len(xy))
    last_i, last_j = heights.shape[0] - 1, heights.shape[1] - 1
    for k in range(len(xy)):
        u = min(max((xy[k, 0] - first_x) / CELL_M, 0.0), float(last_i))
        v = min(max((xy[k, 1] - first_y) / CELL_M, 0.0), float(last_j))
        i, j = min(int(u), max(last_i - 1, 0)), min(int(v), max(last_j - 1, 0))
        u, v = u - i, v - j
        next_i, next_j = min(i + 1, last_i), min(j + 1, last_j)
        result[k] = (1 - u) * ((1 - v) * heights[i, j] + v * heights[i, next_j]) + u * (
            (1 - v) * heights[next_i, j] + v * heights[next_i, next_j]
        )
    return result
