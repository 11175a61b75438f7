"""The convolutional layers of a PointPillars network as sums at chosen cells.

A layer is a sum of convolutions of earlier maps, which covers the concatenation of pillars
and cluster map and the additions of the neck.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from torch import Tensor, nn

from lidar_perception.detectors.pointpillars import sparse_kernels as kernels
from lidar_perception.detectors.pointpillars.network import FpnNeck, PointPillars

Grid = tuple[int, int]


class Term(NamedTuple):
    """A convolution of map number `source`; weights (blocks, taps, channels, BLOCK) float32 as in
    kernels.convolve."""

    source: int
    weights: np.ndarray
    stride: int

    @property
    def margin(self) -> int:
        """Number of cells that it reads beyond the one in the middle."""
        return 1 if self.weights.shape[1] == 9 else 0


@dataclass(frozen=True)
class Layer:
    """The sum of a bias (C,), of convolutions, and of map number `coarse` enlarged `scale` times;
    a sum below floor becomes floor."""

    bias: np.ndarray
    terms: tuple[Term, ...]
    floor: float = -math.inf
    coarse: int | None = None
    scale: int = 1

    def grid(self, grids: Sequence[Grid]) -> Grid:
        """Return (H, W) of its map, from those of the maps before it."""
        height, width = grids[self.terms[0].source]
        return height // self.terms[0].stride, width // self.terms[0].stride

    def reached(self, occupied: Sequence[np.ndarray]) -> np.ndarray:
        """Return (H, W) bool, True where its value depends on an occupied cell of the maps before
        it."""
        masks = [dilated(occupied[term.source], term.margin)[::term.stride, ::term.stride]
                 for term in self.terms]
        if self.coarse is not None:
            masks.append(dilated(enlarged(occupied[self.coarse], self.scale),
                                 (self.scale + 1) // 2))
        return np.logical_or.reduce(masks)

    def require(self, needed: np.ndarray, sources: Sequence[np.ndarray]) -> None:
        """Set in sources, one mask for each map before it, the cells that its cells needed (H, W)
        are computed from."""
        for term in self.terms:
            read = np.zeros_like(sources[term.source])
            read[::term.stride, ::term.stride] = needed
            sources[term.source][:] |= dilated(read, term.margin)
        if self.coarse is not None:
            sources[self.coarse][:] |= dilated(shrunk(needed, self.scale), 1)

    def margin(self, margins: Sequence[int]) -> int:
        """Return the number of cells along each border in which its map of an empty cloud may
        differ from the value inside; margins: those of the maps before it."""
        own = [-(-margins[term.source] // term.stride) + term.margin for term in self.terms]
        if self.coarse is not None:
            own.append((margins[self.coarse] + 1) * self.scale)
        return max(own)


def dilated(mask: np.ndarray, cells: int) -> np.ndarray:
    """Return (H, W) bool, True within `cells` of a True of mask (H, W) along both axes."""
    for _ in range(cells):
        rows = mask.copy()
        rows[1:] |= mask[:-1]
        rows[:-1] |= mask[1:]
        mask = rows.copy()
        mask[:, 1:] |= rows[:, :-1]
        mask[:, :-1] |= rows[:, 1:]
    return mask


def enlarged(mask: np.ndarray, scale: int) -> np.ndarray:
    """Return mask (H, W) with each cell repeated as scale x scale cells."""
    return mask.repeat(scale, axis=0).repeat(scale, axis=1)


def shrunk(mask: np.ndarray, scale: int) -> np.ndarray:
    """Return, for each scale x scale cells of mask (H, W), True if any of them is."""
    rows = np.logical_or.reduce([mask[i::scale] for i in range(scale)])
    return np.logical_or.reduce([rows[:, i::scale] for i in range(scale)])


def make_layers(network: PointPillars) -> list[Layer]:
    """Return the layers of a fused network with an FpnNeck that adds; the last gives the scores of
    the head, the one before it what the head reads. Map 0 is of the pillars, map 1 of the clusters
    if the network has that branch, and then comes the map of each layer."""
    layers: list[Layer] = []
    inputs = 1 if network.map_net is None else 2

    def add(convolution: nn.Module, sources: Sequence[int], relu: bool = True,
            coarse: int | None = None, scale: int = 1) -> int:
        assert isinstance(convolution, nn.Conv2d)
        widths = [network.pillar_net.linear.out_features if source == 0 else 3
                  if source < inputs else outputs[source - inputs] for source in sources]
        parts = convolution.weight.detach().split(widths, dim=1)
        terms = tuple(Term(source, packed(part), convolution.stride[0])
                      for source, part in zip(sources, parts))
        bias = padded_bias(convolution.bias, terms[0].weights.shape[0] * kernels.BLOCK)
        layers.append(Layer(bias, terms, 0.0 if relu else -math.inf, coarse, scale))
        outputs.append(convolution.out_channels)
        return inputs + len(layers) - 1

    outputs: list[int] = []
    sources = [0]
    if network.map_net is not None:
        last = 1
        for module in network.map_net:
            last = add(next(module.children()), [last])
        sources = [0, last]
    levels = []
    for block in network.blocks:
        for module in block.children():
            sources = [add(next(module.children()), sources)]
        levels += sources
    neck = network.neck
    assert isinstance(neck, FpnNeck)
    joined: int | None = None
    for lateral, level, scale in zip(reversed(neck.laterals), reversed(levels),
                                     [1, *reversed(neck.scales)]):
        joined = add(lateral, [level], relu=False, coarse=joined, scale=scale)
    assert joined is not None
    add(network.head.scores, [add(next(neck.out.children()), [joined])], relu=False)
    return layers


def packed(weight: Tensor) -> np.ndarray:
    """Return weights (O, I, k, k) of a convolution as in kernels.convolve, filled up with zeros."""
    out, channels, *window = weight.shape
    taps = math.prod(window)
    blocks = -(-out // kernels.BLOCK)
    filled = np.zeros((blocks * kernels.BLOCK, padded(channels), taps), np.float32)
    filled[:out, :channels] = weight.reshape(out, channels, taps).numpy()
    return np.ascontiguousarray(
        filled.reshape(blocks, kernels.BLOCK, -1, taps).transpose(0, 3, 2, 1))


def padded(channels: int) -> int:
    """Return the number of channels that a row of an input map has."""
    return -(-channels // kernels.UNROLL) * kernels.UNROLL


def padded_bias(bias: Tensor | None, width: int) -> np.ndarray:
    """Return a bias (O,) or None as (width,) float32, filled up with zeros."""
    filled = np.zeros(width, np.float32)
    if bias is not None:
        filled[:len(bias)] = bias.detach().numpy()
    return filled
