"""Node of the fused detector: ~/input/points -> ~/output/detections."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidar_perception.detectors.custom import find_reference, load_custom_detector
from lidar_perception.detectors.fused.fusion import find_fused_weights
from lidar_perception.detectors.fused.params import STEPS, FusedDetectorParams
from lidar_perception.nodes.detector_node import DetectorNode
from lidar_perception.nodes.outputs import DetectionOutputs
from lidar_perception.nodes.runtime import CLOUD
from lidar_perception.nodes.sensor_check import SensorCheck
from lidar_perception.params import DetectionNodeParams

if TYPE_CHECKING:
    from lidar_perception.detectors.fused.detector import FusedDetector
    from lidar_perception.detectors.pointpillars.config import NetworkConfig


class FusedNode(DetectorNode):
    """Uses the columns `ground` and `cluster_id` if the cloud has them."""

    group = "fused"
    steps = STEPS

    def __init__(self, **options: Any):
        super().__init__("fused_detector", FusedDetectorParams(), DetectionNodeParams(), **options)

    def configure(self) -> None:
        """Load the networks, or the class that fused.weights names as module:Class."""
        if (reference := find_reference(self.params.fused.weights)) is None:
            super().configure()
            return
        self.sensor = SensorCheck(self)
        self.outputs = DetectionOutputs(self, self.steps)
        self.detector = load_custom_detector(
            reference, self.params.fused.device, self.params.fused.range, params=self.params, group=self.group
        )
        self.counts.update(network=f"{reference}, {' '.join(self.detector.classes)}", device=self.detector.device)
        self.input("points", CLOUD, self.on_points)

    def weights(self) -> Path:
        return find_fused_weights(self.params.fused)

    def load(self, weights: Path, device: str) -> FusedDetector:
        from lidar_perception.detectors.fused.detector import load_fused_detector

        return load_fused_detector(weights, device, self.params)

    def describe_network(self, config: NetworkConfig) -> str:
        return f"PointPillars {config.version} {config.size} and PointNet"
