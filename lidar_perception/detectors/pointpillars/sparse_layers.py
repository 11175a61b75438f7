"""The convolutional layers of a PointPillars network for sparse evaluation.

Each layer is a sum of convolutions of earlier maps. Such sums also express the concatenation of
the pillars with the cluster map, and the additions in the neck.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidar_perception.detectors.layer_weights import LayerWeights
from lidar_perception.detectors.matrix_kernel import BLOCK, pack_weights, pad_bias
from lidar_perception.detectors.pointpillars.config import NetworkConfig

Grid = tuple[int, int]


@dataclass(frozen=True)
class Layer:
    """A convolution of concatenated maps, optionally plus an upsampled coarser map.

    Attributes:
        sources: indices of the concatenated maps.
        weights: for each source, (blocks, taps, channels, BLOCK) float32 as in kernels.convolve,
            with 9 taps for a 3 x 3 or 1 for a 1 x 1 convolution.
        bias: (C,) float32.
        floor: lower limit of the result; 0 for ReLU.
        coarse: index of a map to upsample by `scale` and add; None: no such map.
    """

    sources: tuple[int, ...]
    weights: tuple[np.ndarray, ...]
    bias: np.ndarray
    stride: int = 1
    floor: float = -math.inf
    coarse: int | None = None
    scale: int = 1

    @property
    def window(self) -> int:
        """Number of cells that the convolution reads on each side of its centre."""
        return 1 if self.weights[0].shape[1] == 9 else 0

    def compute_grid(self, grids: Sequence[Grid]) -> Grid:
        """Return the size (H, W) of the layer's output, given the sizes of earlier maps."""
        height, width = grids[self.sources[0]]
        return height // self.stride, width // self.stride

    def find_affected_cells(self, masks: Sequence[np.ndarray]) -> np.ndarray:
        """Return a mask (H, W) bool of the output cells that depend on an occupied cell of an earlier map.

        `masks` are the masks (H, W) bool of the occupied cells of the earlier maps.
        """
        occupied_inputs = np.logical_or.reduce([masks[source] for source in self.sources])
        mask = dilate(occupied_inputs, self.window)[:: self.stride, :: self.stride]
        if self.coarse is None:
            return mask
        return mask | dilate(enlarge(masks[self.coarse], self.scale), (self.scale + 1) // 2)

    def mark_required_cells(self, output_cells: np.ndarray, masks: Sequence[np.ndarray | None]) -> None:
        """Mark the cells of earlier maps that are required to compute `output_cells`.

        Args:
            output_cells: (H, W) bool.
            masks: mask of each map, changed in place; None if the whole map is computed.
        """
        for source in self.sources:
            if (mask := masks[source]) is not None:
                input_cells = np.zeros_like(mask)
                input_cells[:: self.stride, :: self.stride] = output_cells
                mask |= dilate(input_cells, self.window)
        if self.coarse is not None and (mask := masks[self.coarse]) is not None:
            mask |= dilate(shrink(output_cells, self.scale), 1)

    def compute_margin(self, margins: Sequence[int]) -> int:
        """Return the width in cells of the border where an empty cloud's output may differ from the interior.

        `margins` are the widths for the earlier maps.
        """
        width = max(-(-margins[source] // self.stride) for source in self.sources) + self.window
        if self.coarse is None:
            return width
        return max(width, (margins[self.coarse] + 1) * self.scale)


def dilate(mask: np.ndarray, cells: int) -> np.ndarray:
    """Return the mask (H, W) dilated by `cells` along both axes."""
    for _ in range(cells):
        rows = mask.copy()
        rows[1:] |= mask[:-1]
        rows[:-1] |= mask[1:]
        mask = rows.copy()
        mask[:, 1:] |= rows[:, :-1]
        mask[:, :-1] |= rows[:, 1:]
    return mask


def enlarge(mask: np.ndarray, scale: int) -> np.ndarray:
    """Upsample a mask (H, W) by `scale`, repeating each cell."""
    return mask.repeat(scale, axis=0).repeat(scale, axis=1)


def shrink(mask: np.ndarray, scale: int) -> np.ndarray:
    """Downsample a mask (H, W) by `scale`; a cell is True if any of its scale x scale cells is."""
    rows = np.logical_or.reduce([mask[i::scale] for i in range(scale)])
    return np.logical_or.reduce([rows[:, i::scale] for i in range(scale)])


def make_layers(config: NetworkConfig, tensors: LayerWeights) -> list[Layer]:
    """Return the layers of a network with an additive FPN neck.

    The last layer computes the scores of the head, and the one before it the input of the head. Map
    0 contains the pillars, and map 1 the clusters if the network has that branch. They are followed
    by one map per layer.
    """
    layers: list[Layer] = []
    widths = [config.pillar_channels, 3][: 2 if config.pseudo_map else 1]  # numbers of channels of the maps

    def add_layer(
        name: str,
        sources: Sequence[int],
        out: int,
        kernel: int = 3,
        stride: int = 1,
        has_norm: bool = True,
        coarse: int | None = None,
        scale: int = 1,
    ) -> int:
        input_widths = [widths[source] for source in sources]
        layer, norm = (f"{name}.0", f"{name}.1") if has_norm else (name, None)
        weight, bias = tensors.take(layer, (out, sum(input_widths), kernel, kernel), norm)
        parts = np.split(weight.reshape(out, sum(input_widths), -1), np.cumsum(input_widths)[:-1], axis=1)
        weights = tuple(map(pack_weights, parts))
        layers.append(
            Layer(
                tuple(sources),
                weights,
                pad_bias(bias, len(weights[0]) * BLOCK),
                stride,
                0.0 if has_norm else -math.inf,
                coarse,
                scale,
            )
        )
        widths.append(out)
        return len(widths) - 1

    sources = [0]
    if config.pseudo_map:
        last = 1
        for i, out in enumerate(config.map_channels):
            last = add_layer(f"map_net.{i}", [last], out)
        sources = [0, last]
    levels = []
    for i, (out, extra_layers, stride) in enumerate(
        zip(config.block_channels, config.block_layers, config.block_strides)
    ):
        for k in range(1 + extra_layers):
            sources = [add_layer(f"blocks.{i}.{k}", sources, out, stride=1 if k else stride)]
        levels += sources
    fused_map: int | None = None
    scales = [*config.block_strides[1:], 1]
    for i in reversed(range(len(levels))):
        fused_map = add_layer(
            f"neck.laterals.{i}", [levels[i]], config.fpn_channels, 1, has_norm=False, coarse=fused_map, scale=scales[i]
        )
    assert fused_map is not None
    features = add_layer("neck.out", [fused_map], config.fpn_channels)
    add_layer("head.scores", [features], config.anchors_per_cell * len(config.classes), 1, has_norm=False)
    return layers
