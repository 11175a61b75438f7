"""Inference of PointNet: classes and boxes of clusters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from lidar_perception.detectors.nms import apply_nms
from lidar_perception.detectors.params import NmsParams
from lidar_perception.detectors.pointnet.box_head import Outputs, decode
from lidar_perception.detectors.pointnet.clusters import ClusterInput, Clusters, make_network_input
from lidar_perception.detectors.pointnet.config import PointNetConfig
from lidar_perception.types import Detections


class Network(Protocol):
    """A PointNet that predict() can run.

    Attributes:
        temperature, offsets: (1,) and (K + 1,) float32, see compute_probabilities.
    """

    config: PointNetConfig
    temperature: np.ndarray
    offsets: np.ndarray

    def to(self, device: str) -> None:
        """Move the network to another device if it supports this."""

    def __call__(self, inputs: ClusterInput) -> Outputs[np.ndarray]:
        """Return the outputs for K clusters; K may be 0."""


@dataclass(frozen=True)
class Predictions:
    """Predictions for K clusters.

    Attributes:
        probabilities: (K, C + 1) float32, calibrated probabilities of the C classes and the
            background.
        labels: (K,) int64, the most likely class except background, or the requested class.
        boxes: (K, 7) float32, the box of an object of this class, in the frame of the clusters.
    """

    probabilities: np.ndarray
    labels: np.ndarray
    boxes: np.ndarray

    @property
    def scores(self) -> np.ndarray:
        """Probability of each label, (K,)."""
        return self.probabilities[np.arange(len(self.labels)), self.labels]

    def take(self, indices: np.ndarray) -> Predictions:
        """Return the predictions for the clusters at indices (M,)."""
        return Predictions(self.probabilities[indices], self.labels[indices], self.boxes[indices])


def select_detections(
    predictions: Predictions, config: PointNetConfig, min_scores: Sequence[float], nms: NmsParams = NmsParams()
) -> Detections:
    """Apply NMS to the boxes that reach the minimum score of their class, min_scores (C,)."""
    indices = np.flatnonzero(predictions.scores >= np.asarray(min_scores)[predictions.labels])
    indices = indices[np.argsort(-predictions.scores[indices], kind="stable")][: nms.candidates]
    return apply_nms(
        predictions.boxes[indices], predictions.scores[indices], predictions.labels[indices], config.classes, nms
    )


def predict(network: Network, clusters: Clusters, seed: int = 0, labels: np.ndarray | None = None) -> Predictions:
    """Return the predictions for K clusters; K may be 0.

    Args:
        labels: (K,) int64, class for which each box is predicted; None: the most likely class.
    """
    config, class_count = network.config, len(network.config.classes)
    if len(clusters) == 0:
        return Predictions(
            np.zeros((0, class_count + 1), np.float32), np.zeros(0, np.int64), np.zeros((0, 7), np.float32)
        )
    inputs = make_network_input(clusters, config.points, seed, config.farthest_count)
    outputs = network(inputs)
    probabilities = compute_probabilities(outputs.logits, network.temperature, network.offsets)
    if labels is None:
        labels = probabilities[:, :class_count].argmax(axis=1)
    return Predictions(probabilities, labels, decode(outputs, inputs, config, labels))


def compute_probabilities(logits: np.ndarray, temperature: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Compute calibrated probabilities softmax(logits / temperature + offsets), (B, K + 1) float32."""
    with np.errstate(all="ignore"):  # broken weights are reported elsewhere
        calibrated_logits = logits / temperature + offsets
        exponentials = np.exp(calibrated_logits - calibrated_logits.max(axis=1, keepdims=True))
        return exponentials / exponentials.sum(axis=1, keepdims=True)
