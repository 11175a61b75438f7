"""Node of the EG-PointPillars detector: ~/input/points -> ~/output/detections."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidar_perception.detectors.pointpillars.params import STEPS, DetectorParams
from lidar_perception.detectors.weights_file import find_pointpillars_weights
from lidar_perception.nodes.detector_node import DetectorNode, NetworkLoader

if TYPE_CHECKING:
    from lidar_perception.detectors.pointpillars.detector import PointPillarsDetector


class PointPillarsNode(DetectorNode):
    """Node of EG-PointPillars. It uses the columns `ground` and `cluster_id` if the cloud has them."""

    def __init__(self, **options: Any):
        loader = NetworkLoader(
            "pointpillars", STEPS, find_pointpillars_weights, _load, lambda config: f"{config.version} {config.size}"
        )
        super().__init__("pointpillars_detector", DetectorParams(), loader, **options)


def _load(weights: Path, device: str, params: DetectorParams) -> PointPillarsDetector:
    from lidar_perception.detectors.pointpillars.detector import load_detector  # loads torch

    return load_detector(weights, device, params)
