"""The cluster network in compiled kernels, for inference on a CPU.

Torch's network fills every cluster up to the same number of points and every group up to the same
number of neighbours, as repeated ones change no maximum. Here only those that are there are
computed. The result is that of torch within rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from lidar_perception.detectors.matrix_kernel import (
    BLOCK,
    LANES,
    multiply,
    packed,
    padded,
    padded_bias,
)
from lidar_perception.detectors.parallel import run_in_parts
from lidar_perception.detectors.pointnet import kernels
from lidar_perception.detectors.pointnet.clusters import ClusterInput
from lidar_perception.detectors.pointnet.network import (
    POINT,
    CoarseNet,
    LinearNormRelu,
    LocalNet,
    Outputs,
    PointNet,
)

CHUNK = 32  # clusters whose rows stay in the cache

ZERO, NO_FLOOR = np.float32(0), np.float32(-np.inf)


class Layer(NamedTuple):
    """A linear layer of C values: weights and bias as in matrix_kernel.multiply, and whether ReLU
    follows."""

    weights: np.ndarray
    bias: np.ndarray
    channels: int
    relu: bool

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """Return (R, C and more), zero beyond C, of rows (R, B)."""
        return multiply(rows, self.weights, self.bias, ZERO if self.relu else NO_FLOOR)


class CompiledPointNet:
    """A fused network on the CPU, in eval mode. Several threads may call it at once. Only where
    LANES is not 0."""

    def __init__(self, network: PointNet):
        assert LANES
        self.network, self.config = network, network.config
        self.points = _layers(network.points)
        self.raw = None if network.raw is None else _layers(network.raw)
        self.fine = None if network.fine is None else _layers(network.fine)
        self.local = None if network.local is None else _Local(
            network.local, self.points[-1].channels)
        self.coarse = None if network.coarse is None else _Coarse(network.coarse)
        self.head = _layers(network.head)
        outputs = [network.classes, network.box]
        self.outputs = _layer(torch.cat([layer.weight for layer in outputs]),
                              torch.cat([layer.bias for layer in outputs]), relu=False)

    def __call__(self, inputs: ClusterInput) -> Outputs:
        """Compute what the network returns for K clusters; K may be 0."""
        classes, bins = len(self.config.classes) + 1, self.config.yaw_bins
        values = np.empty((len(inputs.context), self.outputs.channels), np.float32)

        def compute(begin: int, end: int) -> None:
            for first in range(begin, end, CHUNK):
                rows = slice(first, min(first + CHUNK, end))
                values[rows] = self._values(inputs.points[rows], inputs.valid[rows],
                                            inputs.context[rows])

        run_in_parts(compute, len(values), -(-len(values) // CHUNK))
        return Outputs(*torch.from_numpy(values).split([classes, 3, 3, bins, bins], dim=1))

    def _values(self, points: np.ndarray, valid: np.ndarray, context: np.ndarray) -> np.ndarray:
        """Return (K, C) for a few clusters, the arguments as in ClusterInput."""
        sizes = valid.sum(axis=1)
        first = np.concatenate([[0], np.cumsum(sizes)])
        rows = np.zeros((first[-1], padded(POINT)), np.float32)
        rows[:, :POINT] = points[valid]
        dense = (sizes / np.float32(self.config.points))[:, None].astype(np.float32)
        features = _through(self.points, rows)
        found, shallow = [], [kernels.maxima(features, first, self.points[-1].channels)]
        if self.local is not None:
            assert self.fine is not None
            local, first_centre = self.local(rows, first, features, self.config.centroids)
            fine = _through(self.fine, local)
            found.append(kernels.maxima(fine, first_centre, self.fine[-1].channels))
            shallow.append(kernels.maxima(local, first_centre, self.local.join[-1].channels))
            if self.coarse is not None:
                coarse = self.coarse(rows, first, local, first_centre, self.config.coarse)
                found.append(coarse * (np.float32(0.5) + dense))
        if self.raw is not None:
            raw = kernels.maxima(_through(self.raw, features), first, self.raw[-1].channels)
            found.append(raw * (np.float32(1.5) - dense) if self.config.mrg else raw)
        if self.config.skip:
            found += shallow
        joined = _side_by_side([*found, context])
        return self.outputs(_through(self.head, joined))[:, :self.outputs.channels]


class _Local:
    """LocalNet; its groups hold only the points that are there."""

    def __init__(self, net: LocalNet, shallow: int):
        self.shallow = shallow  # width of the features of a point
        self.radii = np.array([radius for radius, _ in net.groups], np.float32)
        self.counts = np.array([count for _, count in net.groups])
        self.nets = [_layers(scale) for scale in net.nets]
        self.join = _layers(net.join)

    def __call__(self, rows: np.ndarray, first: np.ndarray, features: np.ndarray,
                 most: int) -> tuple[np.ndarray, np.ndarray]:
        """Return (R, C) for the centres of all clusters, and the first of each (K + 1,)."""
        relative, starts, density, first_centre = kernels.grouped(rows, first, most, self.radii,
                                                                  self.counts)
        weights = density / density.sum(axis=1, keepdims=True) * np.float32(len(self.counts))
        scales = []
        for s, layers in enumerate(self.nets):
            values = _through(layers, relative[s, :starts[s, -1]])
            scales.append(kernels.maxima(values, starts[s], layers[-1].channels)
                          * weights[:, s:s + 1])
        own = np.repeat(first[:-1] - first_centre[:-1], np.diff(first_centre)) + np.arange(
            first_centre[-1])
        scales.append(features[own, :self.shallow])
        return _through(self.join, _side_by_side(scales)), first_centre


class _Coarse:
    """CoarseNet; the maximum over all groups of a cluster."""

    def __init__(self, net: CoarseNet):
        self.radius, self.count = np.float32(net.radius), net.neighbours
        linear = _linear(net.net[0])
        of_position, of_features = linear.weight.detach().split([3, linear.in_features - 3], dim=1)
        self.features = _layer(of_features, linear.bias, relu=False)
        self.position = np.zeros((3, len(self.features.bias)), np.float32)
        self.position[:, :linear.out_features] = of_position.T.numpy()

    def __call__(self, rows: np.ndarray, first: np.ndarray, local: np.ndarray,
                 first_centre: np.ndarray, most: int) -> np.ndarray:
        """Return (K, C) from the features local (R, B) of the centres of each cluster."""
        greatest = kernels.coarse_maxima(rows, first, self.features(local), first_centre, most,
                                         self.count, self.radius, self.position)
        return greatest[:, :self.features.channels]


def _layers(net: nn.Module) -> list[Layer]:
    return [_layer(linear.weight, linear.bias, relu=True)
            for linear in map(_linear, net.children())]


def _linear(layer: nn.Module) -> nn.Linear:
    assert isinstance(layer, LinearNormRelu)
    linear = layer[0]
    assert isinstance(linear, nn.Linear)
    return linear


def _layer(weight: Tensor, bias: Tensor | None, relu: bool) -> Layer:
    weights = packed(weight.detach()[:, :, None].numpy())
    own = None if bias is None else bias.detach().numpy()
    return Layer(weights, padded_bias(own, len(weights) * BLOCK), len(weight), relu)


def _through(layers: Sequence[Layer], rows: np.ndarray) -> np.ndarray:
    for layer in layers:
        rows = layer(rows)
    return rows


def _side_by_side(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return parts (R, C_i) as (R, C) float32, filled up with zeros as layers read them."""
    width = sum(part.shape[1] for part in parts)
    joined = np.zeros((len(parts[0]), padded(width)), np.float32)
    np.concatenate(parts, axis=1, out=joined[:, :width])
    return joined
