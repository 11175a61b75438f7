"""Node of the EG-PointPillars detector: ~/input/points -> ~/output/detections."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lidar_perception.detectors.pointpillars.params import STEPS, DetectorParams
from lidar_perception.detectors.weights_file import find_pointpillars_weights
from lidar_perception.nodes.detector_node import DetectorNode


class PointPillarsNode(DetectorNode):
    """Node of EG-PointPillars. It uses the columns `ground` and `cluster_id` if the cloud has them."""

    group, steps = "pointpillars", STEPS

    def __init__(self, **options: Any):
        super().__init__(DetectorParams(), **options)

    def find_weights(self) -> Path:
        return find_pointpillars_weights(self.params.pointpillars)

    def load_detector(self, weights: Path, device: str) -> Any:
        from lidar_perception.detectors.pointpillars.detector import load_detector  # imports torch

        return load_detector(weights, device, self.params)

    def describe_network(self, config: Any) -> str:
        return f"{config.version} {config.size}"
