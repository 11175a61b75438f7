"""Node of the EG-PointPillars detector: ~/input/points -> ~/output/detections."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidar_perception.detectors.pointpillars.params import STEPS, DetectorParams
from lidar_perception.detectors.weights_file import find_pointpillars_weights
from lidar_perception.nodes.detector_node import DetectorNode
from lidar_perception.params import DetectionNodeParams

if TYPE_CHECKING:
    from lidar_perception.detectors.pointpillars.config import NetworkConfig
    from lidar_perception.detectors.pointpillars.detector import PointPillarsDetector


class PointPillarsNode(DetectorNode):
    """Uses the columns `ground` and `cluster_id` if the cloud has them."""

    group = "pointpillars"
    steps = STEPS

    def __init__(self, **options: Any):
        super().__init__("pointpillars_detector", DetectorParams(), DetectionNodeParams(), **options)

    def weights(self) -> Path:
        return find_pointpillars_weights(self.params.pointpillars)

    def load(self, weights: Path, device: str) -> PointPillarsDetector:
        from lidar_perception.detectors.pointpillars.detector import load_detector

        return load_detector(weights, device, self.params)

    def describe_network(self, config: NetworkConfig) -> str:
        return f"{config.version} {config.size}"
