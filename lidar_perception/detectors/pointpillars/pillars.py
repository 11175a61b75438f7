"""Points to pillars, without a loop and without padding, on any device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
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
        kept = first_of_each(cells, config.max_points)
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


def first_of_each(cells: Tensor, count: int) -> Tensor:
    """Ascending indices (M,) of the first `count` points of each cell, in the cloud's order."""
    ordered, indices = torch.sort(cells, stable=True)
    _, sizes = torch.unique_consecutive(ordered, return_counts=True)
    starts = torch.repeat_interleave(torch.cumsum(sizes, 0) - sizes, sizes)
    rank = torch.arange(len(cells), device=cells.device) - starts
    return torch.sort(indices[rank < count]).values
