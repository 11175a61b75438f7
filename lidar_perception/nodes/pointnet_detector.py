"""Node of the PointNet detector: ~/input/points -> ~/output/detections."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidar_perception.detectors.pointnet.params import STEPS, PointNetDetectorParams
from lidar_perception.detectors.weights_file import find_pointnet_weights
from lidar_perception.nodes.detector_node import DetectorNode, NetworkLoader

if TYPE_CHECKING:
    from lidar_perception.detectors.pointnet.detector import PointNetDetector


class PointNetNode(DetectorNode):
    """Node of the PointNet detector.

    It uses the column `cluster_id`; without it, the node computes ground and clusters itself.
    """

    def __init__(self, **options: Any):
        loader = NetworkLoader("pointnet", STEPS, find_pointnet_weights, _load, lambda config: config.name)
        super().__init__("pointnet_detector", PointNetDetectorParams(), loader, **options)


def _load(weights: Path, device: str, params: PointNetDetectorParams) -> PointNetDetector:
    from lidar_perception.detectors.pointnet.detector import load_pointnet_detector  # loads torch

    return load_pointnet_detector(weights, device, params)
