"""Node of the fused detector: ~/input/points -> ~/output/detections."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidar_perception.detectors.fused.fusion import find_fused_weights
from lidar_perception.detectors.fused.params import STEPS, FusedDetectorParams
from lidar_perception.nodes.detector_node import DetectorNode, NetworkLoader

if TYPE_CHECKING:
    from lidar_perception.detectors.fused.detector import FusedDetector
    from lidar_perception.detectors.pointpillars.config import NetworkConfig


class FusedNode(DetectorNode):
    """Node of the fused detector, or of a custom detector if fused.weights is its module:Class.

    It uses the columns `ground` and `cluster_id` if the cloud has them.
    """

    def __init__(self, **options: Any):
        loader = NetworkLoader("fused", STEPS, find_fused_weights, _load, _describe_network, allows_custom=True)
        super().__init__("fused_detector", FusedDetectorParams(), loader, **options)


def _load(weights: Path, device: str, params: FusedDetectorParams) -> FusedDetector:
    from lidar_perception.detectors.fused.detector import load_fused_detector  # loads torch

    return load_fused_detector(weights, device, params)


def _describe_network(config: NetworkConfig) -> str:
    return f"PointPillars {config.version} {config.size} and PointNet"
