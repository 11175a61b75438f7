"""Plain implementation of PointNet++ with single-scale grouping (Qi et al., NeurIPS 2017).

It is written like many small repositories: farthest point sampling in a loop, ball query by sorting
all distances, and 1 x 1 convolutions on the groups. It has the layer widths of our network, and is
used only for timing.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from lidar_perception.detectors.pointnet.config import PointNetConfig


def sample_farthest(xyz: Tensor, count: int) -> Tensor:
    """Return indices (B, count) of points (B, N, 3), each of which is farthest from the previous ones."""
    batch, size = xyz.shape[:2]
    indices = torch.zeros(batch, count, dtype=torch.long)
    distances, last = torch.full((batch, size), 1e10), torch.zeros(batch, dtype=torch.long)
    batch_rows = torch.arange(batch)
    for i in range(count):
        indices[:, i] = last
        distances = torch.minimum(distances, ((xyz - xyz[batch_rows, last][:, None]) ** 2).sum(-1))
        last = distances.argmax(dim=1)
    return indices


def query_ball(radius: float, count: int, xyz: Tensor, centres: Tensor) -> Tensor:
    """Return indices (B, M, count) of the first points within the radius of centres (B, M, 3)."""
    size = xyz.shape[1]
    indices = torch.arange(size).expand(*centres.shape[:2], size).clone()
    indices[torch.cdist(centres, xyz) > radius] = size
    indices = indices.sort(dim=-1).values[..., :count]
    return torch.where(indices == size, indices[..., :1].clamp(max=size - 1), indices)


class SetAbstraction(nn.Module):
    """Layer that groups points in balls and applies shared layers and max pooling to each group."""

    def __init__(self, count: int, radius: float, neighbours: int, *channels: int):
        super().__init__()
        self.count, self.radius, self.neighbours = count, radius, neighbours
        layers = []
        for a, b in pairwise(channels):
            layers += [nn.Conv2d(a, b, 1), nn.BatchNorm2d(b), nn.ReLU()]
        self.layers = nn.Sequential(*layers)

    def forward(self, xyz: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
        batch_rows = torch.arange(len(xyz))[:, None]
        centres = xyz[batch_rows, sample_farthest(xyz, self.count)]
        indices = query_ball(self.radius, self.neighbours, xyz, centres)
        rows = torch.cat(
            [xyz[batch_rows[:, :, None], indices] - centres[:, :, None], features[batch_rows[:, :, None], indices]],
            dim=-1,
        )
        return centres, self.layers(rows.permute(0, 3, 2, 1)).amax(dim=2).transpose(1, 2)


class PlainPointNet2(nn.Module):
    """Network from points (B, N, 5) to (B, classes + 1) logits and (B, 6 + 2 Y) box values."""

    def __init__(self, config: PointNetConfig):
        super().__init__()
        local_width, global_width = config.local_channels, config.global_channels
        self.first = SetAbstraction(
            config.centroids, config.radii[-1], config.neighbours[-1], 5, *config.group_channels, local_width
        )
        self.second = SetAbstraction(
            config.coarse, config.coarse_radius, config.coarse_neighbours, 3 + local_width, global_width
        )
        sizes, layers = (global_width, *config.head_channels), []
        for a, b in pairwise(sizes):
            layers += [nn.Linear(a, b), nn.BatchNorm1d(b), nn.ReLU()]
        self.head = nn.Sequential(*layers, nn.Linear(sizes[-1], len(config.classes) + 1 + 6 + 2 * config.yaw_bins))

    def forward(self, points: Tensor) -> Tensor:
        xyz, features = self.first(points[..., :3], points[..., 3:])
        return self.head(self.second(xyz, features)[1].amax(dim=1))
