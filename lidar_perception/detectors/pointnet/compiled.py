"""PointNet with compiled kernels, for inference on a CPU.

The torch network pads all clusters and groups to the same size with repeated points, which do not
change a maximum. This implementation needs no padding. The result equals that of torch up to
rounding.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np

from lidar_perception.detectors.layer_weights import LayerWeights, Weights
from lidar_perception.detectors.matrix_kernel import BLOCK, LANES, multiply, pack_weights, pad_bias, pad_channels
from lidar_perception.detectors.parallel import run_in_parts
from lidar_perception.detectors.pointnet import kernels
from lidar_perception.detectors.pointnet.box_head import Outputs
from lidar_perception.detectors.pointnet.clusters import CONTEXT, POINT, ClusterInput
from lidar_perception.detectors.pointnet.config import PointNetConfig

NORM_EPS = 1e-5  # epsilon of the batch norms
CHUNK = 32  # clusters per batch, few enough for the cache

ZERO, NO_FLOOR = np.float32(0), np.float32(-np.inf)


class Layer(NamedTuple):
    """A linear layer with `channels` outputs; weights and bias as in matrix_kernel.multiply."""

    weights: np.ndarray
    bias: np.ndarray
    channels: int
    relu: bool

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """Apply the layer to rows (R, B); outputs beyond `channels` are 0."""
        return multiply(rows, self.weights, self.bias, ZERO if self.relu else NO_FLOOR)


class CompiledPointNet:
    """PointNet with compiled kernels on a CPU with LANES > 0; it can be called from several threads.

    Args:
        tensors: state_dict of network.PointNet(config), by name.

    Raises:
        WeightsMismatch: the tensors belong to a different network.
    """

    def __init__(self, config: PointNetConfig, tensors: Mapping[str, np.ndarray]):
        assert LANES
        self.config = config
        weights = LayerWeights(tensors, NORM_EPS)
        shallow_width, local_width, global_width = (
            config.point_channels[-1],
            config.local_channels,
            config.global_channels,
        )
        self.points = _take_layers(weights, "points", POINT, *config.point_channels)
        self.raw = self.fine = self.local = self.coarse = None
        feature_count = (shallow_width + (local_width if config.groups else 0)) if config.skip else 0
        if config.groups:
            self.local = _CompiledLocalNet(config, weights)
            self.fine = _take_layers(weights, "fine", local_width, global_width)
            feature_count += global_width
        if config.mrg:
            self.coarse = _CompiledCoarseNet(config, weights)
            feature_count += global_width
        if config.mrg or not config.groups:
            self.raw = _take_layers(weights, "raw", shallow_width, global_width)
            feature_count += global_width
        self.head = _take_layers(weights, "head", feature_count + CONTEXT, *config.head_channels)
        self.widths = [len(config.classes) + 1, 3, 3, config.yaw_bins, config.yaw_bins]
        outputs = [
            weights.take(name, (width, config.head_channels[-1]))
            for name, width in (("classes", self.widths[0]), ("box", sum(self.widths[1:])))
        ]
        weight, bias = map(np.concatenate, zip(*outputs))
        self.outputs = _make_layer(weight, bias, relu=False)
        self.temperature = weights.take_array("temperature", (1,))
        self.offsets = weights.take_array("offsets", (self.widths[0],))
        weights.require_all_taken()

    def to(self, device: str) -> None:
        """Do nothing: the network stays on the CPU."""

    def __call__(self, inputs: ClusterInput) -> Outputs[np.ndarray]:
        """Return the outputs of the network for K clusters; K may be 0."""
        values = np.empty((len(inputs.context), self.outputs.channels), np.float32)

        def compute(begin: int, end: int) -> None:
            for first in range(begin, end, CHUNK):
                rows = slice(first, min(first + CHUNK, end))
                values[rows] = self._evaluate(inputs.points[rows], inputs.valid[rows], inputs.context[rows])

        run_in_parts(compute, len(values), -(-len(values) // CHUNK))
        return Outputs(*np.split(values, [*accumulate(self.widths[:-1])], axis=1))

    def _evaluate(self, points: np.ndarray, valid: np.ndarray, context: np.ndarray) -> np.ndarray:
        """Return all outputs (K, C) for a batch of clusters; arguments as in ClusterInput."""
        sizes = valid.sum(axis=1)
        first = np.concatenate([[0], np.cumsum(sizes)])
        rows = np.zeros((first[-1], pad_channels(POINT)), np.float32)
        rows[:, :POINT] = points[valid]
        density = (sizes / np.float32(self.config.points))[:, None].astype(np.float32)
        features = _apply_layers(self.points, rows)
        parts, shallow_features = [], [kernels.compute_group_maxima(features, first, self.points[-1].channels)]
        if self.local is not None:
            assert self.fine is not None
            local_features, first_centre = self.local(rows, first, features, self.config.centroids)
            fine_features = _apply_layers(self.fine, local_features)
            parts.append(kernels.compute_group_maxima(fine_features, first_centre, self.fine[-1].channels))
            shallow_features.append(
                kernels.compute_group_maxima(local_features, first_centre, self.local.join[-1].channels)
            )
            if self.coarse is not None:
                coarse_features = self.coarse(rows, first, local_features, first_centre, self.config.coarse)
                parts.append(coarse_features * (np.float32(0.5) + density))
        if self.raw is not None:
            raw_features = kernels.compute_group_maxima(_apply_layers(self.raw, features), first, self.raw[-1].channels)
            parts.append(raw_features * (np.float32(1.5) - density) if self.config.mrg else raw_features)
        if self.config.skip:
            parts += shallow_features
        head_input = _concatenate_padded([*parts, context])
        return self.outputs(_apply_layers(self.head, head_input))[:, : self.outputs.channels]


class _CompiledLocalNet:
    """LocalNet without padding: groups contain only actual points."""

    def __init__(self, config: PointNetConfig, weights: LayerWeights):
        self.shallow_width = config.point_channels[-1]
        self.uses_ball_density = config.density == "ball"
        radii, counts = zip(*config.groups)
        self.radii, self.counts = np.array(radii, np.float32), np.array(counts)
        self.nets = [_take_layers(weights, f"local.nets.{i}", POINT, *config.group_channels) for i in range(len(radii))]
        self.join = _take_layers(
            weights, "local.join", len(radii) * config.group_channels[-1] + self.shallow_width, config.local_channels
        )

    def __call__(
        self, rows: np.ndarray, first: np.ndarray, features: np.ndarray, max_centres: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the features (R, C) of the centroids of all clusters, and each cluster's first centroid (K + 1,)."""
        relative, starts, density, first_centre = kernels.group_neighbours(
            rows, first, max_centres, self.radii, self.counts, self.uses_ball_density
        )
        weights = density / density.sum(axis=1, keepdims=True) * np.float32(len(self.counts))
        scales = []
        for s, layers in enumerate(self.nets):
            values = _apply_layers(layers, relative[s, : starts[s, -1]])
            scales.append(kernels.compute_group_maxima(values, starts[s], layers[-1].channels) * weights[:, s : s + 1])
        centre_rows = np.repeat(first[:-1] - first_centre[:-1], np.diff(first_centre)) + np.arange(first_centre[-1])
        scales.append(features[centre_rows, : self.shallow_width])
        return _apply_layers(self.join, _concatenate_padded(scales)), first_centre


class _CompiledCoarseNet:
    """CoarseNet without padding, with the maximum over all groups of a cluster."""

    def __init__(self, config: PointNetConfig, weights: LayerWeights):
        self.radius, self.count = np.float32(config.coarse_radius), config.coarse_neighbours
        weight, bias = _take_norm_layer(weights, "coarse.net.0", 3 + config.local_channels, config.global_channels)
        self.feature_layer = _make_layer(weight[:, 3:], bias, relu=False)
        self.position_weights = np.zeros((3, len(self.feature_layer.bias)), np.float32)
        self.position_weights[:, : len(weight)] = weight[:, :3].T

    def __call__(
        self, rows: np.ndarray, first: np.ndarray, local: np.ndarray, first_centre: np.ndarray, max_groups: int
    ) -> np.ndarray:
        """Return features (K, C) from the features `local` (R, B) of the centroids."""
        maxima = kernels.compute_coarse_maxima(
            rows,
            first,
            self.feature_layer(local),
            first_centre,
            max_groups,
            self.count,
            self.radius,
            self.position_weights,
        )
        return maxima[:, : self.feature_layer.channels]


def _take_layers(weights: LayerWeights, name: str, *channels: int) -> list[Layer]:
    """Remove the layers of network.make_mlp(*channels) from the weights and return them."""
    return [
        _make_layer(*_take_norm_layer(weights, f"{name}.{i}", channels_in, channels_out), relu=True)
        for i, (channels_in, channels_out) in enumerate(pairwise(channels))
    ]


def _take_norm_layer(weights: LayerWeights, name: str, channels: int, out: int) -> Weights:
    """Remove a network.LinearNormRelu from the weights and return it."""
    return weights.take(f"{name}.0", (out, channels), f"{name}.1")


def _make_layer(weight: np.ndarray, bias: np.ndarray | None, relu: bool) -> Layer:
    packed_weights = pack_weights(weight[:, :, None])
    return Layer(packed_weights, pad_bias(bias, len(packed_weights) * BLOCK), len(weight), relu)


def _apply_layers(layers: Sequence[Layer], rows: np.ndarray) -> np.ndarray:
    for layer in layers:
        rows = layer(rows)
    return rows


def _concatenate_padded(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Concatenate arrays (R, C_i) to (R, C) float32, padded with zeros for the next layer."""
    width = sum(part.shape[1] for part in parts)
    padded_rows = np.zeros((len(parts[0]), pad_channels(width)), np.float32)
    np.concatenate(parts, axis=1, out=padded_rows[:, :width])
    return padded_rows
