"""Points to pillars, without padding: of one cloud on the CPU in a compiled loop, of several clouds
or on another device in torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from lidar_perception.detectors.pointpillars.config import NetworkConfig


class Pillars(NamedTuple):
    """The N points of B clouds that lie in the range, each with its pillar.

    points (N, 4 or 5) float32 [x y z intensity (id)], offsets (N, 5 or 6) float32
    [x_c y_c z_c x_p y_p (z_p)], metres: from the mean of the pillar's points and from its middle
    (Lang et al., Section 2.1).
    cells (N,) int64 into B * H * W, row by row, rows along y; grid is (H, W). Clouds may be empty.
    """

    points: Tensor
    offsets: Tensor
    cells: Tensor
    batch: int
    grid: tuple[int, int]


def make_pillars(clouds: Sequence[Tensor], config: NetworkConfig) -> Pillars:
    """Pillars of clouds, each (N_b, config.point_columns) float32 on one device. Points out of
    range are left out, and those with NaN. Only max_points of a pillar stay, if that is set."""
    if len(clouds) == 1 and clouds[0].device.type == "cpu":
        points, offsets, cells = map(torch.from_numpy, _of_one_cloud(
            np.ascontiguousarray(clouds[0].numpy()), np.array(config.low, np.float32),
            np.array(config.high, np.float32), np.float32(config.cell), *config.grid,
            config.max_points, config.offset_columns))
        return Pillars(points, offsets, cells, 1, config.grid)
    points = torch.cat(list(clouds))
    sizes = torch.tensor([len(cloud) for cloud in clouds], device=points.device)
    sample = torch.repeat_interleave(sizes)
    low, high = points.new_tensor(config.low), points.new_tensor(config.high)
    inside = ((points[:, :3] >= low) & (points[:, :3] < high)).all(dim=1)  # NaN is not
    inside &= torch.isfinite(points[:, 3:]).all(dim=1)
    if not inside.all():
        points, sample = points[inside], sample[inside]
    height, width = config.grid
    column = ((points[:, 0] - low[0]) / config.cell).long().clamp_(max=width - 1)
    row = ((points[:, 1] - low[1]) / config.cell).long().clamp_(max=height - 1)
    cells = (sample * height + row) * width + column
    if config.max_points:
        kept = keep_first_per_cell(cells, config.max_points)
        points, cells, column, row = points[kept], cells[kept], column[kept], row[kept]
    middle = torch.stack([points[:, 0] - ((column + 0.5) * config.cell + low[0]),
                          points[:, 1] - ((row + 0.5) * config.cell + low[1]),
                          points[:, 2] - (low[2] + high[2]) / 2], dim=1)
    # Means of offsets: their sums stay small, so the order of the points hardly matters.
    counted = torch.cat([middle, torch.ones_like(middle[:, :1])], dim=1)
    sums = counted.new_zeros(len(clouds) * height * width, 4).index_add_(0, cells, counted)[cells]
    offsets = torch.cat([middle - sums[:, :3] / sums[:, 3:],
                         middle[:, :config.offset_columns - 3]], dim=1)
    return Pillars(points, offsets, cells, len(clouds), config.grid)


@njit(cache=True, nogil=True)
def _of_one_cloud(cloud, low, high, cell, height, width, most, columns):
    """points, offsets and cells of Pillars, with the same roundings as in torch."""
    points = np.empty_like(cloud)
    offsets = np.empty((len(cloud), columns), np.float32)
    cells = np.empty(len(cloud), np.int64)
    sums = np.zeros((height * width, 4), np.float32)
    half, count = np.float32(0.5), 0
    middle_z = (low[2] + high[2]) / np.float32(2)
    for i in range(len(cloud)):
        point = cloud[i]
        inside = True
        for axis in range(3):
            inside &= low[axis] <= point[axis] < high[axis]
        for k in range(3, len(point)):
            inside &= np.isfinite(point[k])
        if not inside:
            continue
        column = min(int((point[0] - low[0]) / cell), width - 1)
        row = min(int((point[1] - low[1]) / cell), height - 1)
        own = row * width + column
        if most and sums[own, 3] >= most:
            continue
        points[count] = point
        cells[count] = own
        offsets[count, 3] = point[0] - ((np.float32(column) + half) * cell + low[0])
        offsets[count, 4] = point[1] - ((np.float32(row) + half) * cell + low[1])
        offsets[count, 2] = point[2] - middle_z
        sums[own, 0] += offsets[count, 3]
        sums[own, 1] += offsets[count, 4]
        sums[own, 2] += offsets[count, 2]
        sums[own, 3] += np.float32(1)
        count += 1
    for i in range(count):
        own = sums[cells[i]]
        if columns > 5:
            offsets[i, 5] = offsets[i, 2]
        offsets[i, 0] = offsets[i, 3] - own[0] / own[3]
        offsets[i, 1] = offsets[i, 4] - own[1] / own[3]
        offsets[i, 2] -= own[2] / own[3]
    return points[:count].copy(), offsets[:count].copy(), cells[:count].copy()


def keep_first_per_cell(cells: Tensor, count: int) -> Tensor:
    """Ascending indices (M,) of the first `count` points of each cell, in the cloud's order."""
    ordered, indices = torch.sort(cells, stable=True)
    _, sizes = torch.unique_consecutive(ordered, return_counts=True)
    starts = torch.repeat_interleave(torch.cumsum(sizes, 0) - sizes, sizes)
    rank = torch.arange(len(cells), device=cells.device) - starts
    return torch.sort(indices[rank < count]).values
