"""Assignment of the points of several clouds to pillars, in torch, on any device."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lidar_perception.detectors.pointpillars.config import NetworkConfig
from lidar_perception.detectors.pointpillars.pillars import Pillars


def make_pillar_batch(clouds: Sequence[Tensor], config: NetworkConfig) -> Pillars[Tensor]:
    """Assign the points of several clouds to pillars, see make_pillars.

    Args:
        clouds: each (N_b, config.point_columns) float32, all on one device.
    """
    points = torch.cat(list(clouds))
    sizes = torch.tensor([len(cloud) for cloud in clouds], device=points.device)
    cloud_indices = torch.repeat_interleave(sizes)
    low, high = points.new_tensor(config.low), points.new_tensor(config.high)
    is_valid = ((points[:, :3] >= low) & (points[:, :3] < high)).all(dim=1)  # False for NaN
    is_valid &= torch.isfinite(points[:, 3:]).all(dim=1)
    if not is_valid.all():
        points, cloud_indices = points[is_valid], cloud_indices[is_valid]
    height, width = config.grid
    column = ((points[:, 0] - low[0]) / config.cell).long().clamp_(max=width - 1)
    row = ((points[:, 1] - low[1]) / config.cell).long().clamp_(max=height - 1)
    cells = (cloud_indices * height + row) * width + column
    if config.max_points:
        first_indices = keep_first_per_cell(cells, config.max_points)
        points, cells, column, row = (
            points[first_indices],
            cells[first_indices],
            column[first_indices],
            row[first_indices],
        )
    centre_offsets = torch.stack(
        [
            points[:, 0] - ((column + 0.5) * config.cell + low[0]),
            points[:, 1] - ((row + 0.5) * config.cell + low[1]),
            points[:, 2] - (low[2] + high[2]) / 2,
        ],
        dim=1,
    )
    # Sums of offsets are small, so rounding errors, which depend on the order of the points, are negligible.
    offsets_and_ones = torch.cat([centre_offsets, torch.ones_like(centre_offsets[:, :1])], dim=1)
    sums = offsets_and_ones.new_zeros(len(clouds) * height * width, 4).index_add_(0, cells, offsets_and_ones)[cells]
    offsets = torch.cat(
        [centre_offsets - sums[:, :3] / sums[:, 3:], centre_offsets[:, : config.offset_columns - 3]], dim=1
    )
    return Pillars(points, offsets, cells, len(clouds), config.grid)


def keep_first_per_cell(cells: Tensor, count: int) -> Tensor:
    """Return the indices (M,), ascending, of the first `count` points of each cell."""
    sorted_cells, indices = torch.sort(cells, stable=True)
    _, sizes = torch.unique_consecutive(sorted_cells, return_counts=True)
    starts = torch.repeat_interleave(torch.cumsum(sizes, 0) - sizes, sizes)
    rank = torch.arange(len(cells), device=cells.device) - starts
    return torch.sort(indices[rank < count]).values
