"""The improved PointNet of paper C (Eq. 13 to 17), its ablations and baselines; see config.py.

    points -> PointMlp --------------------------+-> raw ----------------+
                 +-> LocalNet (MSG, Eq. 14) -> max -> fine --------------+-> head -> class, box
                         +-> CoarseNet (MRG, Eq. 15) -> max -> coarse ---+
                 shallow features by a skip connection (Eq. 16) ---------+

B clusters, N points, M centroids, k neighbours, C channels. Clusters with fewer than N points are
padded with copies of their points, which do not change a maximum. `valid` is False for copies; they
are not used as neighbours. Neighbours outside the radius are replaced by the nearest one, which is
the centroid itself.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_linear_bn_eval

from lidar_perception.detectors.checkpoint import Header, load_checkpoint
from lidar_perception.detectors.pointnet.box_head import Outputs
from lidar_perception.detectors.pointnet.clusters import CONTEXT, POINT
from lidar_perception.detectors.pointnet.config import PointNetConfig


class LinearNormRelu(nn.Sequential):
    """Linear layer, batch norm over all axes but the last, and ReLU."""

    def __init__(self, channels: int, out: int):
        super().__init__(nn.Linear(channels, out, bias=False), nn.BatchNorm1d(out), nn.ReLU(inplace=True))

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.reshape(-1, x.shape[-1])).view(*x.shape[:-1], -1)

    def apply_to_groups(self, positions: Tensor, features: Tensor, indices: Tensor) -> Tensor:
        """Apply the layer to the members of groups.

        The input of a member is its position concatenated with a row of features. Each row is
        multiplied by its weights only once, even if it belongs to several groups.

        Args:
            positions: (B, M, k, 3) relative positions of the members.
            features: (B, N, C).
            indices: (B, M, k) row in `features` of each member.
        """
        linear, norm, relu = self
        assert isinstance(linear, nn.Linear)
        position_weight, feature_weight = linear.weight.split([positions.shape[-1], features.shape[-1]], dim=1)
        x = functional.linear(positions, position_weight, linear.bias).add_(
            gather_rows(functional.linear(features, feature_weight), indices)
        )
        return relu(norm(x.flatten(0, 2))).view(x.shape)


def make_mlp(*channels: int) -> nn.Sequential:
    """Make a multilayer perceptron with these layer widths."""
    return nn.Sequential(*(LinearNormRelu(a, b) for a, b in pairwise(channels)))


def compute_squared_distances(centres: Tensor, xyz: Tensor, valid: Tensor) -> Tensor:
    """Return the squared distances (B, M, N) of centres (B, M, 3) to points xyz (B, N, 3).

    Distances to points that are not valid are inf.
    """
    # Unlike a matrix product, differences give a distance of exactly 0 from a point to itself. The
    # axes are added one by one because a sum over an axis of length 3 takes four times as long.
    x, y, z = ((a[:, :, None] - b[:, None]).square() for a, b in zip(centres.unbind(-1), xyz.unbind(-1)))
    return (x + y + z).masked_fill(~valid[:, None], torch.inf)


def find_nearest(squared: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Find the `count` points nearest to each centre, given squared distances (B, M, N).

    Returns:
        Squared distances (B, M, k), ascending, inf beyond the last valid point; and indices
        (B, M, k).
    """
    return squared.topk(count, dim=2, largest=False)


def gather_rows(values: Tensor, indices: Tensor) -> Tensor:
    """Return the rows (B, M, k, C) of values (B, N, C) at indices (B, M, k)."""
    offsets = torch.arange(values.shape[0], device=values.device)[:, None, None] * values.shape[1]
    rows = values.flatten(0, 1).index_select(0, (indices + offsets).flatten())
    return rows.view(*indices.shape, -1)


class LocalNet(nn.Module):
    """Local features: points grouped around each centroid at several radii, weighted by density (Eq. 14, 17).

    All radii share one neighbour search.
    """

    def __init__(
        self, groups: Sequence[tuple[float, int]], channels: Sequence[int], point_channels: int, out: int, density: str
    ):
        super().__init__()
        self.groups, self.density = list(groups), density
        self.nets = nn.ModuleList(make_mlp(POINT, *channels) for _ in groups)
        self.join = make_mlp(len(groups) * channels[-1] + point_channels, out)

    def forward(self, points: Tensor, features: Tensor, valid: Tensor, count: int) -> Tensor:
        xyz, centres = points[..., :3], points[:, :count, :3]
        distances = compute_squared_distances(centres, xyz, valid)  # (B, M, N)
        squared, indices = find_nearest(distances, max(k for _, k in self.groups))
        scales, density = [], []
        for (radius, k), net in zip(self.groups, self.nets):
            is_in_radius = squared[..., :k] <= radius * radius  # (B, M, k)
            neighbours = gather_rows(points, torch.where(is_in_radius, indices[..., :k], indices[..., :1]))
            offsets = (neighbours[..., :3] - centres[:, :, None]) / radius  # (B, M, k, 3)
            scales.append(net(torch.cat([offsets, neighbours[..., 3:]], dim=-1)).amax(dim=2))
            density.append(
                is_in_radius.sum(dim=-1) / (k * radius)
                if self.density == "neighbours"
                else (distances <= radius * radius).sum(dim=-1) / radius**3
            )
        weights = torch.stack(density, dim=-1)  # (B, M, scales)
        weights = weights / weights.sum(dim=-1, keepdim=True) * len(self.groups)
        scales = [scale * weights[..., i : i + 1] for i, scale in enumerate(scales)]
        return self.join(torch.cat([*scales, features[:, :count]], dim=-1))  # (B, M, C)


class CoarseNet(nn.Module):
    """Coarse features: local features of centroids, grouped around some of the centroids (Eq. 15)."""

    def __init__(self, channels: int, out: int, radius: float, neighbours: int):
        super().__init__()
        self.radius, self.neighbours = radius, neighbours
        self.net = nn.Sequential(LinearNormRelu(channels + 3, out))

    def forward(self, xyz: Tensor, features: Tensor, valid: Tensor, count: int) -> Tensor:
        centres = xyz[:, :count]
        squared, indices = find_nearest(compute_squared_distances(centres, xyz, valid), self.neighbours)
        indices = torch.where(squared <= self.radius**2, indices, indices[..., :1])
        offsets = (gather_rows(xyz, indices) - centres[:, :, None]) / self.radius
        layer = self.net[0]
        assert isinstance(layer, LinearNormRelu)
        return layer.apply_to_groups(offsets, features, indices).amax(dim=2)


class PointNet(nn.Module):
    """PointNet for B clusters, with points (B, N, 5), valid (B, N) and context (B, 6) as in ClusterInput."""

    temperature: Tensor
    offsets: Tensor

    def __init__(self, config: PointNetConfig):
        super().__init__()
        self.config = config
        shallow_width, local_width, global_width = (
            config.point_channels[-1],
            config.local_channels,
            config.global_channels,
        )
        self.points = make_mlp(POINT, *config.point_channels)
        self.local: LocalNet | None = None
        self.coarse: CoarseNet | None = None
        self.raw: nn.Module | None = None
        self.fine: nn.Module | None = None
        feature_count = 0
        if config.groups:
            self.local = LocalNet(config.groups, config.group_channels, shallow_width, local_width, config.density)
            self.fine = make_mlp(local_width, global_width)
            feature_count += global_width
        if config.mrg:
            self.coarse = CoarseNet(local_width, global_width, config.coarse_radius, config.coarse_neighbours)
            feature_count += global_width
        if config.mrg or not config.groups:
            self.raw = make_mlp(shallow_width, global_width)
            feature_count += global_width
        if config.skip:
            feature_count += shallow_width + (local_width if config.groups else 0)
        classes, bins = len(config.classes), config.yaw_bins
        self.head = make_mlp(feature_count + CONTEXT, *config.head_channels)
        self.classes = nn.Linear(config.head_channels[-1], classes + 1)
        self.box = nn.Linear(config.head_channels[-1], 6 + 2 * bins)
        # Parameters of the calibration, see predict.compute_probabilities.
        self.register_buffer("temperature", torch.ones(1))
        self.register_buffer("offsets", torch.zeros(classes + 1))

    def forward(self, points: Tensor, valid: Tensor, context: Tensor) -> Outputs[Tensor]:
        config = self.config
        features = self.points(points)  # (B, N, C)
        parts, shallow_features = [], [features.amax(dim=1)]
        # Grouped features have more weight in dense clusters, single points in sparse ones (Eq. 17).
        density = valid.sum(dim=1, keepdim=True) / config.points  # (B, 1)
        if self.local is not None and self.fine is not None:
            local_features = self.local(points, features, valid, config.centroids)  # (B, M, C)
            parts.append(self.fine(local_features).amax(dim=1))  # (B, C)
            shallow_features.append(local_features.amax(dim=1))
        if self.coarse is not None:
            centroids, valid_centroids = points[:, : config.centroids, :3], valid[:, : config.centroids]
            coarse_features = self.coarse(centroids, local_features, valid_centroids, config.coarse)  # (B, M', C)
            parts.append(coarse_features.amax(dim=1) * (0.5 + density))
        if self.raw is not None:
            raw_features = self.raw(features).amax(dim=1)
            parts.append(raw_features * (1.5 - density) if config.mrg else raw_features)
        if config.skip:
            parts += shallow_features
        x = self.head(torch.cat([*parts, context], dim=1))
        box = self.box(x)
        bins = config.yaw_bins
        return Outputs(self.classes(x), box[:, :3], box[:, 3:6], box[:, 6 : 6 + bins], box[:, 6 + bins :])


def fuse_norms(network: PointNet) -> PointNet:
    """Return a copy of a network for inference, with all batch norms folded into the layers before them."""
    network = copy.deepcopy(network).eval()
    for module in network.modules():
        if isinstance(module, LinearNormRelu):
            linear, norm, _ = module
            if isinstance(linear, nn.Linear) and isinstance(norm, nn.BatchNorm1d):
                module[0], module[1] = fuse_linear_bn_eval(linear, norm), nn.Identity()
    return network


def load_pointnet(path: str | Path, expected: PointNetConfig | None = None) -> tuple[Header, PointNet]:
    """Load the header and the network of a checkpoint, in float32, on the CPU and in training mode.

    Raises:
        InputError: the file cannot be used, or its config differs from `expected`.
    """
    return load_checkpoint(path, PointNetConfig, PointNet, expected)
