"""The cluster network in compiled kernels, for inference on a CPU.

Torch's network fills every cluster up to the same number of points and every group up to the same
number of neighbours, as repeated ones change no maximum. Here only those that are there are
computed. The result is that of torch within rounding.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np

from lidar_perception.detectors.layer_weights import LayerWeights, Weights
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
from lidar_perception.detectors.pointnet.box_head import Outputs
from lidar_perception.detectors.pointnet.clusters import CONTEXT, POINT, ClusterInput
from lidar_perception.detectors.pointnet.config import PointNetConfig

NORM_EPS = 1e-5  # of batch norms
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
    """A network on the CPU. Several threads may call it at once. Only where LANES is not 0.

    Args:
        tensors: name -> array, the state_dict of network.make_pointnet(config).

    Raises:
        Misfit: the tensors are those of another network.
    """

    def __init__(self, config: PointNetConfig, tensors: Mapping[str, np.ndarray]):
        assert LANES
        self.config = config
        weights = LayerWeights(tensors, NORM_EPS)
        shallow, local, wide = (config.point_channels[-1], config.local_channels,
                                config.global_channels)
        self.points = _layers(weights, "points", POINT, *config.point_channels)
        self.raw = self.fine = self.local = self.coarse = None
        found = (shallow + (local if config.groups else 0)) if config.skip else 0
        if config.groups:
            self.local = _Local(config, weights)
            self.fine = _layers(weights, "fine", local, wide)
            found += wide
        if config.mrg:
            self.coarse = _Coarse(config, weights)
            found += wide
        if config.mrg or not config.groups:
            self.raw = _layers(weights, "raw", shallow, wide)
            found += wide
        self.head = _layers(weights, "head", found + CONTEXT, *config.head_channels)
        self.widths = [len(config.classes) + 1, 3, 3, config.yaw_bins, config.yaw_bins]
        outputs = [weights.take(name, (width, config.head_channels[-1])) for name, width in (
            ("classes", self.widths[0]), ("box", sum(self.widths[1:])))]
        weight, bias = map(np.concatenate, zip(*outputs))
        self.outputs = _layer(weight, bias, relu=False)
        self.temperature = weights.array("temperature", (1,))
        self.offsets = weights.array("offsets", (self.widths[0],))
        weights.finish()

    def to(self, device: str) -> None:
        """Stay on the CPU."""

    def __call__(self, inputs: ClusterInput) -> Outputs[np.ndarray]:
        """Compute what the network returns for K clusters; K may be 0."""
        values = np.empty((len(inputs.context), self.outputs.channels), np.float32)

        def compute(begin: int, end: int) -> None:
            for first in range(begin, end, CHUNK):
                rows = slice(first, min(first + CHUNK, end))
                values[rows] = self._values(inputs.points[rows], inputs.valid[rows],
                                            inputs.context[rows])

        run_in_parts(compute, len(values), -(-len(values) // CHUNK))
        return Outputs(*np.split(values, [*accumulate(self.widths[:-1])], axis=1))

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

    def __init__(self, config: PointNetConfig, weights: LayerWeights):
        self.shallow = config.point_channels[-1]  # width of the features of a point
        radii, counts = zip(*config.groups)
        self.radii, self.counts = np.array(radii, np.float32), np.array(counts)
        self.nets = [_layers(weights, f"local.nets.{i}", POINT, *config.group_channels)
                     for i in range(len(radii))]
        self.join = _layers(weights, "local.join", len(radii) * config.group_channels[-1]
                            + self.shallow, config.local_channels)

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

    def __init__(self, config: PointNetConfig, weights: LayerWeights):
        self.radius, self.count = np.float32(config.coarse_radius), config.coarse_neighbours
        weight, bias = _normed(weights, "coarse.net.0", 3 + config.local_channels,
                               config.global_channels)
        self.features = _layer(weight[:, 3:], bias, relu=False)
        self.position = np.zeros((3, len(self.features.bias)), np.float32)
        self.position[:, :len(weight)] = weight[:, :3].T

    def __call__(self, rows: np.ndarray, first: np.ndarray, local: np.ndarray,
                 first_centre: np.ndarray, most: int) -> np.ndarray:
        """Return (K, C) from the features local (R, B) of the centres of each cluster."""
        greatest = kernels.coarse_maxima(rows, first, self.features(local), first_centre, most,
                                         self.count, self.radius, self.position)
        return greatest[:, :self.features.channels]


def _layers(weights: LayerWeights, name: str, *channels: int) -> list[Layer]:
    """Take the layers of network.mlp(*channels)."""
    return [_layer(*_normed(weights, f"{name}.{i}", read, out), relu=True)
            for i, (read, out) in enumerate(pairwise(channels))]


def _normed(weights: LayerWeights, name: str, channels: int, out: int) -> Weights:
    """Take a network.LinearNormRelu."""
    return weights.take(f"{name}.0", (out, channels), f"{name}.1")


def _layer(weight: np.ndarray, bias: np.ndarray | None, relu: bool) -> Layer:
    values = packed(weight[:, :, None])
    return Layer(values, padded_bias(bias, len(values) * BLOCK), len(weight), relu)


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
