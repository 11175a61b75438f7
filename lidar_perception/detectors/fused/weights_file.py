"""Where the weights are, found without loading torch."""

from __future__ import annotations

from pathlib import Path

from lidar_perception.detectors.fused.params import FusedParams
from lidar_perception.detectors.pointnet.params import PointNetParams
from lidar_perception.detectors.pointnet.weights_file import weights_file as classifier_file
from lidar_perception.detectors.pointpillars.params import PointPillarsParams
from lidar_perception.detectors.pointpillars.weights_file import weights_file as proposer_file


def weights_file(params: FusedParams) -> Path:
    """The file of PointPillars' weights. InputError if it, or the classifier's, is not there."""
    classifier_file(PointNetParams(weights=params.classifier))
    return proposer_file(PointPillarsParams(weights=params.weights))
