"""Assignment of a cloud's points to pillars, without padding, on the CPU."""

from __future__ import annotations

from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numba import njit

from lidar_perception.detectors.pointpillars.config import NetworkConfig

Array = TypeVar("Array")  # NumPy array or torch tensor


class Pillars(NamedTuple, Generic[Array]):
    """The N points of B clouds in the network's range, with their pillars; N may be 0.

    Attributes:
        points: (N, 4 or 5) float32 [x y z intensity (id)], metres.
        offsets: (N, 5 or 6) float32 [x_c y_c z_c x_p y_p (z_p)], metres, from the mean of the
            pillar's points and from the centre of the pillar (Lang et al., Section 2.1).
        cells: (N,) int64 flat indices into (B, H, W), with rows along y.
        batch: B.
        grid: (H, W).
    """

    points: Array
    offsets: Array
    cells: Array
    batch: int
    grid: tuple[int, int]


def make_pillars(cloud: np.ndarray, config: NetworkConfig) -> Pillars[np.ndarray]:
    """Assign the points of a cloud (N, config.point_columns) float32 to pillars.

    Points outside the range and points with NaN are dropped. If config.max_points is set, at most
    that many points of each pillar are kept.
    """
    points, offsets, cells = _make_pillars(
        np.ascontiguousarray(cloud),
        np.array(config.low, np.float32),
        np.array(config.high, np.float32),
        np.float32(config.cell),
        *config.grid,
        config.max_points,
        config.offset_columns,
    )
    return Pillars(points, offsets, cells, 1, config.grid)


@njit(cache=True, nogil=True)
def _make_pillars(cloud, low, high, cell_size, height, width, max_points, offset_columns):
    """Return points, offsets and cells of Pillars, with exactly the same rounding as torch."""
    points = np.empty_like(cloud)
    offsets = np.empty((len(cloud), offset_columns), np.float32)
    cells = np.empty(len(cloud), np.int64)
    sums = np.zeros((height * width, 4), np.float32)
    half, count = np.float32(0.5), 0
    middle_z = (low[2] + high[2]) / np.float32(2)
    for i in range(len(cloud)):
        point = cloud[i]
        is_valid = True
        for axis in range(3):
            is_valid &= low[axis] <= point[axis] < high[axis]
        for k in range(3, len(point)):
            is_valid &= np.isfinite(point[k])
        if not is_valid:
            continue
        column = min(int((point[0] - low[0]) / cell_size), width - 1)
        row = min(int((point[1] - low[1]) / cell_size), height - 1)
        pillar = row * width + column
        if max_points and sums[pillar, 3] >= max_points:
            continue
        points[count] = point
        cells[count] = pillar
        offsets[count, 3] = point[0] - ((np.float32(column) + half) * cell_size + low[0])
        offsets[count, 4] = point[1] - ((np.float32(row) + half) * cell_size + low[1])
        offsets[count, 2] = point[2] - middle_z
        sums[pillar, 0] += offsets[count, 3]
        sums[pillar, 1] += offsets[count, 4]
        sums[pillar, 2] += offsets[count, 2]
        sums[pillar, 3] += np.float32(1)
        count += 1
    for i in range(count):
        pillar_sums = sums[cells[i]]
        if offset_columns > 5:
            offsets[i, 5] = offsets[i, 2]
        offsets[i, 0] = offsets[i, 3] - pillar_sums[0] / pillar_sums[3]
        offsets[i, 1] = offsets[i, 4] - pillar_sums[1] / pillar_sums[3]
        offsets[i, 2] -= pillar_sums[2] / pillar_sums[3]
    return points[:count].copy(), offsets[:count].copy(), cells[:count].copy()
