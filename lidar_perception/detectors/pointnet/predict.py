"""Clusters in, a class and a box for each out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from lidar_perception.detectors.nms import apply_nms
from lidar_perception.detectors.params import NmsParams
from lidar_perception.detectors.pointnet.box_head import decode
from lidar_perception.detectors.pointnet.clusters import ClusterInput, Clusters, network_input
from lidar_perception.detectors.pointnet.compiled import CompiledPointNet
from lidar_perception.detectors.pointnet.config import PointNetConfig
from lidar_perception.detectors.pointnet.network import Outputs, PointNet
from lidar_perception.types import Detections

CHUNK = 256  # clusters at a time: bounds the memory, and the caches like it


@dataclass(frozen=True)
class Predictions:
    """Of K clusters: probabilities (K, C + 1) float32 of the C classes of the config and of
    background, calibrated; labels (K,) int64 the likeliest class but background, or the one that
    was asked about; boxes (K, 7) float32 if it is of that class, in the frame of the clusters."""

    probabilities: np.ndarray
    labels: np.ndarray
    boxes: np.ndarray

    @property
    def scores(self) -> np.ndarray:
        """(K,) the probability of the class of labels."""
        return self.probabilities[np.arange(len(self.labels)), self.labels]

    def take(self, chosen: np.ndarray) -> Predictions:
        """Those of the clusters at indices (M,)."""
        return Predictions(self.probabilities[chosen], self.labels[chosen], self.boxes[chosen])


def found(predictions: Predictions, config: PointNetConfig, least: Sequence[float],
          nms: NmsParams = NmsParams()) -> Detections:
    """The boxes whose score is at least `least` of their class, (C,), the best of those that
    overlap."""
    chosen = np.flatnonzero(predictions.scores >= np.asarray(least)[predictions.labels])
    chosen = chosen[np.argsort(-predictions.scores[chosen], kind="stable")][:nms.candidates]
    return apply_nms(predictions.boxes[chosen], predictions.scores[chosen],
                        predictions.labels[chosen], config.classes, nms)


@torch.inference_mode()
def predict(network: PointNet | CompiledPointNet, clusters: Clusters, seed: int = 0,
            chunk: int = CHUNK, labels: np.ndarray | None = None) -> Predictions:
    """What the network, in eval mode, makes of each of K clusters, K may be 0; labels (K,): the
    classes that are asked about, instead of the likeliest."""
    config, classes = network.config, len(network.config.classes)
    if len(clusters) == 0:
        return Predictions(np.zeros((0, classes + 1), np.float32), np.zeros(0, np.int64),
                           np.zeros((0, 7), np.float32))
    inputs = network_input(clusters, config.points, seed)
    if isinstance(network, CompiledPointNet):
        outputs, network = network(inputs), network.network
    else:
        outputs = outputs_of(network, inputs, chunk)
    probabilities = network.probabilities(outputs.logits).cpu().numpy()
    if labels is None:
        labels = probabilities[:, :classes].argmax(axis=1)
    return Predictions(probabilities, labels, decode(outputs, inputs, config, labels))


@torch.inference_mode()
def outputs_of(network: PointNet, inputs: ClusterInput, chunk: int = CHUNK) -> Outputs:
    """The network's outputs for one cluster or more. Most clusters have few points: those that have
    about the same number are taken together, without the places that none of them fills."""
    device, least = network.temperature.device, network.config.least_points
    sizes = np.maximum(inputs.valid.sum(axis=1), least)
    doubled = np.ceil(np.log2(sizes / least))
    order = np.argsort(doubled, kind="stable")
    alike = np.split(order, np.flatnonzero(np.diff(doubled[order])) + 1)
    parts = []
    for rows in alike:
        width = sizes[rows].max()
        for begin in range(0, len(rows), chunk):
            part = rows[begin:begin + chunk]
            parts.append(network(*(torch.from_numpy(x).to(device) for x in (
                inputs.points[part, :width], inputs.valid[part, :width], inputs.context[part]))))
    back = torch.from_numpy(np.argsort(order)).to(device)
    return Outputs(*(torch.cat(column)[back] for column in zip(*parts)))
