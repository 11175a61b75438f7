"""Clusters in, a class and a box for each out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from lidar_perception.pointnet.box_head import decode
from lidar_perception.pointnet.clusters import Clusters, network_input
from lidar_perception.pointnet.network import Outputs, PointNet

CHUNK = 256  # clusters at a time: bounds the memory, and the caches like it


@dataclass(frozen=True)
class Predictions:
    """Of K clusters: probabilities (K, C + 1) float32 of the C classes of the config and of
    background, calibrated; kinds (K,) int64 the likeliest class but background; boxes (K, 7)
    float32 if it is of that class, in the frame of the clusters."""

    probabilities: np.ndarray
    kinds: np.ndarray
    boxes: np.ndarray

    @property
    def scores(self) -> np.ndarray:
        """(K,) the probability of the likeliest class."""
        return self.probabilities[np.arange(len(self.kinds)), self.kinds]


@torch.inference_mode()
def predict(network: PointNet, clusters: Clusters, seed: int = 0, chunk: int = CHUNK
            ) -> Predictions:
    """What the network, in eval mode, makes of each cluster. K may be 0."""
    config, device = network.config, network.temperature.device
    inputs = network_input(clusters, config.points, seed)
    parts = []
    for begin in range(0, len(clusters), chunk):
        part = slice(begin, begin + chunk)
        parts.append(network(*(torch.from_numpy(x[part]).to(device) for x in
                               (inputs.points, inputs.valid, inputs.context))))
    classes = len(config.classes)
    if not parts:
        return Predictions(np.zeros((0, classes + 1), np.float32), np.zeros(0, np.int64),
                           np.zeros((0, 7), np.float32))
    outputs = Outputs(*(torch.cat(column) for column in zip(*parts)))
    probabilities = torch.softmax(outputs.logits.float() / network.temperature, dim=1)
    probabilities = probabilities.cpu().numpy()
    kinds = probabilities[:, :classes].argmax(axis=1)
    return Predictions(probabilities, kinds, decode(outputs, inputs, config, kinds))
