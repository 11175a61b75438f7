"""Node of the fused detector: ~/input/points -> ~/output/detections."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lidar_perception.detectors.fused.fusion import find_fused_weights
from lidar_perception.detectors.fused.params import STEPS, FusedDetectorParams
from lidar_perception.nodes.detector_node import DetectorNode


class FusedNode(DetectorNode):
    """Node of the fused detector, or of a custom detector if fused.weights is its module:Class.

    It uses the columns `ground` and `cluster_id` if the cloud has them.
    """

    group, steps, allows_custom = "fused", STEPS, True

    def __init__(self, **options: Any):
        super().__init__(FusedDetectorParams(), **options)

    def find_weights(self) -> Path:
        return find_fused_weights(self.params.fused)

    def load_detector(self, weights: Path, device: str) -> Any:
        from lidar_perception.detectors.fused.detector import load_fused_detector  # imports torch

        return load_fused_detector(weights, device, self.params)

    def describe_network(self, config: Any) -> str:
        return f"PointPillars {config.version} {config.size} and PointNet"
