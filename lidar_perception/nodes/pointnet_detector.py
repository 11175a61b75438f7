"""Node of the PointNet detector: ~/input/points -> ~/output/detections."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidar_perception.detectors.pointnet.params import STEPS, PointNetDetectorParams
from lidar_perception.detectors.weights_file import find_pointnet_weights
from lidar_perception.nodes.detector_node import DetectorNode
from lidar_perception.params import DetectionNodeParams

if TYPE_CHECKING:
    from lidar_perception.detectors.pointnet.config import PointNetConfig
    from lidar_perception.detectors.pointnet.detector import PointNetDetector


class PointNetNode(DetectorNode):
    """Uses the column `cluster_id`; without it the node finds ground and clusters itself."""

    group = "pointnet"
    steps = STEPS

    def __init__(self, **options: Any):
        super().__init__("pointnet_detector", PointNetDetectorParams(), DetectionNodeParams(), **options)

    def weights(self) -> Path:
        return find_pointnet_weights(self.params.pointnet)

    def load(self, weights: Path, device: str) -> PointNetDetector:
        from lidar_perception.detectors.pointnet.detector import load_pointnet_detector

        return load_pointnet_detector(weights, device, self.params)

    def describe_network(self, config: PointNetConfig) -> str:
        return config.name
