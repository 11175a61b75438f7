"""Node of the PointNet detector: ~/input/points -> ~/output/detections."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lidar_perception.detectors.pointnet.params import STEPS, PointNetDetectorParams
from lidar_perception.detectors.weights_file import find_pointnet_weights
from lidar_perception.nodes.detector_node import DetectorNode


class PointNetNode(DetectorNode):
    """Node of the PointNet detector.

    It uses the column `cluster_id`; without it, the node computes ground and clusters itself.
    """

    group, steps = "pointnet", STEPS

    def __init__(self, **options: Any):
        super().__init__(PointNetDetectorParams(), **options)

    def find_weights(self) -> Path:
        return find_pointnet_weights(self.params.pointnet)

    def load_detector(self, weights: Path, device: str) -> Any:
        from lidar_perception.detectors.pointnet.detector import load_pointnet_detector  # imports torch

        return load_pointnet_detector(weights, device, self.params)

    def describe_network(self, config: Any) -> str:
        return str(config.name)
