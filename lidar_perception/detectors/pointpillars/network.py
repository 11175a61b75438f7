"""The network of PointPillars (Lang et al., CVPR 2019) and EG-PointPillars (paper B).

    points -> PillarNet -> pseudo-image --+-> blocks -> neck -> head -> scores, codes, directions
    cluster map -> MapNet (V4) -----------+

B clouds, N points, H x W pillars, C channels, K classes, A anchors. Images are stored channels-last.
Targets, losses and decoding are in targets.py, losses.py and anchors.py.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval, fuse_linear_bn_eval

from lidar_perception.detectors.checkpoint import Header, Net, load_checkpoint
from lidar_perception.detectors.pointpillars.config import BINS, CODE, NORM_EPS, NetworkConfig
from lidar_perception.detectors.pointpillars.pillars import Pillars

MOMENTUM = 0.01  # momentum of the batch norms
PRIOR = 0.01  # initial score of all anchors

Conv = nn.Conv2d | nn.ConvTranspose2d


class Outputs(NamedTuple):
    """Outputs of the network for B clouds, with anchors as in make_anchors.

    Attributes:
        logits: (B, A, K).
        codes: (B, A, 7).
        directions: (B, A, 2).
    """

    logits: Tensor
    codes: Tensor
    directions: Tensor


class ConvNormRelu(nn.Sequential):
    """Convolution, batch norm and ReLU."""

    def __init__(self, conv: Conv):
        super().__init__(conv, nn.BatchNorm2d(conv.out_channels, NORM_EPS, MOMENTUM), nn.ReLU(inplace=True))


def conv3x3(channels: int, out: int, stride: int = 1) -> ConvNormRelu:
    """Return a 3 x 3 convolution with batch norm and ReLU."""
    return ConvNormRelu(nn.Conv2d(channels, out, 3, stride, padding=1, bias=False))


class PillarNet(nn.Module):
    """Pseudo-image of pillars: a linear layer for each point, and the maximum over each pillar."""

    def __init__(self, config: NetworkConfig):
        super().__init__()
        self.config = config
        self.linear = nn.Linear(config.point_columns + config.offset_columns, config.pillar_channels, bias=False)
        self.norm: nn.Module = nn.BatchNorm1d(config.pillar_channels, NORM_EPS, MOMENTUM)

    @torch.autocast("cuda", enabled=False)
    @torch.autocast("cpu", enabled=False)  # 16 bits would round x = 60 m to 25 cm
    def forward(self, pillars: Pillars[Tensor]) -> Tensor:
        # Cluster ids come last, so that the first inputs are the same with and without them.
        points = pillars.points
        inputs = torch.cat(
            [
                points[:, :2] * self.config.xy_scale,
                points[:, 2:4],
                pillars.offsets,
                points[:, 4:] * self.config.id_scale,
            ],
            dim=1,
        )  # (N, 9 to 11)
        values = functional.relu(self.norm(self.linear(inputs)))  # (N, C)
        height, width = pillars.grid
        count = pillars.batch * height * width
        image = values.new_zeros(count, values.shape[1])  # (B * H * W, C), empty is 0
        if self.config.zero_row:
            image = self._add_zero_rows(image, pillars.cells, inputs[:1])
        # Values are non-negative, so the initial zeros do not affect the maximum.
        image.scatter_reduce_(0, pillars.cells[:, None].expand_as(values), values, "amax")
        return image.view(pillars.batch, height, width, -1).permute(0, 3, 1, 2)  # (B, C, H, W)

    def _add_zero_rows(self, image: Tensor, cells: Tensor, inputs: Tensor) -> Tensor:
        """Add the output for an all-zero point to pillars with fewer than max_points points.

        The image (B * H * W, C) is all zeros. `inputs` (1, I) only gives the shape and dtype of the
        all-zero point.
        """
        ones = torch.ones_like(cells, dtype=image.dtype)
        sizes = image.new_zeros(len(image)).scatter_add(0, cells, ones)
        is_padded = ((sizes > 0) & (sizes < self.config.max_points))[:, None]
        zero_output = functional.relu(self.norm(self.linear(torch.zeros_like(inputs))))
        return image + is_padded * zero_output


class MapNet(nn.Sequential):
    """Cluster Map Feature Net (paper B, Section 3.1.2), from 3 channels to C."""

    def __init__(self, channels: Sequence[int]):
        super().__init__(*(conv3x3(a, b) for a, b in zip((3, *channels), channels)))

    def forward(self, maps: Tensor) -> Tensor:  # (B, 3, H, W) uint8
        maps = maps.to(next(self.parameters()).dtype)
        return super().forward(maps.contiguous(memory_format=torch.channels_last))  # (B, C, H, W)


class DeconvNeck(nn.Module):
    """Neck of PointPillars: upsample the maps of all blocks to the size of the first and concatenate them."""

    def __init__(self, channels: Sequence[int], strides: Sequence[int], out: int):
        super().__init__()
        scales = [math.prod(strides[1 : i + 1]) for i in range(len(strides))]  # 1, 2, 4
        self.ups = nn.ModuleList(
            ConvNormRelu(nn.ConvTranspose2d(c, out, scale, scale, bias=False)) for c, scale in zip(channels, scales)
        )
        self.channels = out * len(channels)

    def forward(self, maps: list[Tensor]) -> Tensor:  # finest first: H/2, H/4, H/8
        return torch.cat([up(x) for up, x in zip(self.ups, maps)], dim=1)  # (B, 3 * out, H/2, W/2)


class FpnNeck(nn.Module):
    """Neck of V1 to V4 (paper B, Eq. 1 to 8).

    Starting from the coarsest map, each map is upsampled bilinearly and fused with the next finer
    map.
    """

    def __init__(self, channels: Sequence[int], strides: Sequence[int], out: int, fusion: str):
        super().__init__()
        self.laterals = nn.ModuleList(nn.Conv2d(c, out, 1) for c in channels)
        self.scales, self.fusion = list(strides[1:]), fusion
        self.out = conv3x3(out * (1 if fusion == "add" else len(channels)), out)
        self.channels = out

    def forward(self, maps: list[Tensor]) -> Tensor:  # finest first: H/2, H/4, H/8
        levels = [lateral(x) for lateral, x in zip(self.laterals, maps)]  # (B, 2C, ...) each
        fused_map = levels.pop()
        for scale, level in zip(reversed(self.scales), reversed(levels)):
            fused_map = functional.interpolate(fused_map, scale_factor=float(scale), mode="bilinear")
            fused_map = fused_map + level if self.fusion == "add" else torch.cat([fused_map, level], dim=1)
        return self.out(fused_map)  # (B, 2C, H/2, W/2)


class Head(nn.Module):
    """Single-shot head: one 1 x 1 convolution each for class, box and heading.

    Detectors compute scores for all anchors, but boxes only for the few with a high score.

    Args:
        per_cell: number of anchors per cell.
        classes: number of classes.
    """

    def __init__(self, channels: int, per_cell: int, classes: int):
        super().__init__()
        self.per_cell, self.classes = per_cell, classes
        self.scores = nn.Conv2d(channels, per_cell * classes, 1)
        self.codes = nn.Conv2d(channels, per_cell * CODE, 1)
        self.directions = nn.Conv2d(channels, per_cell * BINS, 1)
        nn.init.constant_(_get_bias(self.scores), -math.log((1 - PRIOR) / PRIOR))
        for layer, std in ((self.scores, 0.01), (self.codes, 0.001)):
            if not layer.weight.is_meta:  # on the meta device, normal_ would import torch's compiler (2 s)
                nn.init.normal_(layer.weight, std=std)

    def forward(self, features: Tensor) -> Outputs:
        return Outputs(
            _reshape_by_anchor(self.scores(features), self.classes),
            _reshape_by_anchor(self.codes(features), CODE),
            _reshape_by_anchor(self.directions(features), BINS),
        )

    def compute_logits(self, features: Tensor) -> Tensor:
        """Compute only the logits (B, A, K) of forward()."""
        return _reshape_by_anchor(self.scores(features), self.classes)

    def compute_boxes(self, features: Tensor, anchors: Tensor) -> tuple[Tensor, Tensor]:
        """Compute codes (M, 7) and directions (M, 2) of some anchors, given as indices (M,), of a single cloud."""
        rows = features[0].flatten(1)[:, anchors // self.per_cell].T  # (M, C)
        slots = anchors % self.per_cell  # index of each anchor within its cell

        def apply(conv: nn.Conv2d, width: int) -> Tensor:
            weight = conv.weight.view(self.per_cell, width, -1)[slots]  # (M, width, C)
            bias = _get_bias(conv).view(self.per_cell, width)[slots]
            return torch.baddbmm(bias[:, :, None], weight, rows[:, :, None])[:, :, 0]

        return apply(self.codes, CODE), apply(self.directions, BINS)


def _get_bias(conv: nn.Conv2d) -> Tensor:
    assert conv.bias is not None  # all convolutions of the head have a bias
    return conv.bias


def _reshape_by_anchor(x: Tensor, width: int) -> Tensor:
    """Reshape (B, P * width, H, W) to (B, H * W * P, width), where P is the number of anchors per cell."""
    return x.permute(0, 2, 3, 1).reshape(len(x), -1, width)


class PointPillars(nn.Module):
    """The complete network. make_network() makes its parts from a config."""

    def __init__(
        self,
        pillar_net: PillarNet,
        map_net: MapNet | None,
        blocks: Sequence[nn.Module],
        neck: DeconvNeck | FpnNeck,
        head: Head,
    ):
        super().__init__()
        self.pillar_net, self.map_net = pillar_net, map_net
        self.blocks, self.neck, self.head = nn.ModuleList(blocks), neck, head

    def compute_features(self, pillars: Pillars[Tensor], maps: Tensor | None = None) -> Tensor:
        """Compute the input of the head, (B, neck.channels, H/2, W/2).

        Args:
            maps: (B, 3, H, W) uint8 cluster maps, for V4 only.
        """
        x = self.pillar_net(pillars)  # (B, C, H, W)
        if self.map_net is not None:
            x = torch.cat([x, self.map_net(maps)], dim=1)  # (B, C + C', H, W)
        levels = []
        for block in self.blocks:
            x = block(x)  # H/2, H/4, H/8
            levels.append(x)
        return self.neck(levels)

    def forward(self, pillars: Pillars[Tensor], maps: Tensor | None = None) -> Outputs:
        return self.head(self.compute_features(pillars, maps))


def make_network(config: NetworkConfig) -> PointPillars:
    """Make a network with random weights, in training mode."""
    map_net = MapNet(config.map_channels) if config.pseudo_map else None
    channels = config.pillar_channels + (config.map_channels[-1] if config.pseudo_map else 0)
    blocks = []
    for out, layers, stride in zip(config.block_channels, config.block_layers, config.block_strides):
        blocks.append(nn.Sequential(conv3x3(channels, out, stride), *(conv3x3(out, out) for _ in range(layers))))
        channels = out
    neck = (
        DeconvNeck(config.block_channels, config.block_strides, config.deconv_channels)
        if config.neck == "deconv"
        else FpnNeck(config.block_channels, config.block_strides, config.fpn_channels, config.fusion)
    )
    head = Head(neck.channels, config.anchors_per_cell, len(config.anchors))
    return to_channels_last(PointPillars(PillarNet(config), map_net, blocks, neck, head))


def to_channels_last(network: Net) -> Net:
    """Convert the weights of a network in place to the channels-last memory format."""
    return cast(Any, network).to(memory_format=torch.channels_last)  # not in torch's type stubs


def fuse_norms(network: PointPillars) -> PointPillars:
    """Return a copy of a network for inference, with all batch norms folded into the layers before them."""
    network = copy.deepcopy(network).eval()
    for module in network.modules():
        if isinstance(module, ConvNormRelu):
            conv, norm, _ = module
            is_transposed = isinstance(conv, nn.ConvTranspose2d)
            if isinstance(conv, Conv) and isinstance(norm, nn.BatchNorm2d):
                module[0], module[1] = fuse_conv_bn_eval(conv, norm, is_transposed), nn.Identity()
    net = network.pillar_net
    if isinstance(net.norm, nn.BatchNorm1d):
        net.linear, net.norm = fuse_linear_bn_eval(net.linear, net.norm), nn.Identity()
    return to_channels_last(network)


def load_network(path: str | Path, expected: NetworkConfig | None = None) -> tuple[Header, PointPillars]:
    """Load the header and the network of a checkpoint, in float32, on the CPU and in training mode.

    Raises:
        InputError: the file cannot be used, or its config differs from `expected`.
    """
    return load_checkpoint(path, NetworkConfig, make_network, expected)
