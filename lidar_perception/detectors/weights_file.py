"""Paths of the weights of PointPillars and PointNet. Importing this module does not import torch."""

from __future__ import annotations

from pathlib import Path

from lidar_perception.detectors.pointnet.params import PointNetParams
from lidar_perception.detectors.pointpillars.params import PointPillarsParams
from lidar_perception.types import InputError

POINTPILLARS_WEIGHTS = Path(__file__).parent / "pointpillars" / "weights"  # folder with one file per version and size
POINTNET_WEIGHTS = Path(__file__).parent / "pointnet" / "weights" / "pointnet.safetensors"
PROPOSER = "pointpillars_v4_compact_nine_sensors.safetensors"  # proposer of fused, in POINTPILLARS_WEIGHTS
CLASSIFIER = "judge.safetensors"  # classifier of fused, in the folder of POINTNET_WEIGHTS


def require_weights(path: str, parameter: str) -> Path:
    """Return the path of a weights file; raise an InputError that names `parameter` if it does not exist."""
    if not Path(path).is_file():
        raise InputError(f"checkpoint not found: {path}; set {parameter} to an existing file")
    return Path(path)


def find_pointpillars_weights(params: PointPillarsParams) -> Path:
    """Return `params.weights`, by default the shipped file for the version and size in `params`.

    Raises:
        InputError: the file does not exist.
    """
    if params.weights:
        return require_weights(params.weights, "pointpillars.weights")
    version = "v4" if params.version == "auto" else params.version
    size = "compact" if params.size == "auto" else params.size
    path = POINTPILLARS_WEIGHTS / f"pointpillars_{version}_{size}.safetensors"
    return _require_shipped(path, f"{version} {size}", "pointpillars.weights")


def find_proposer_weights() -> Path:
    """Return the path of fused's PointPillars weights; raise InputError if they are missing."""
    return _require_shipped(POINTPILLARS_WEIGHTS / PROPOSER, "fused", "fused.weights")


def find_pointnet_weights(params: PointNetParams) -> Path:
    """Return `params.weights`, by default the shipped file; raise InputError if it does not exist."""
    if params.weights:
        return require_weights(params.weights, "pointnet.weights")
    return _require_shipped(POINTNET_WEIGHTS, "PointNet", "pointnet.weights")


def find_classifier_weights() -> Path:
    """Return the path of fused's PointNet weights; raise InputError if they are missing."""
    return _require_shipped(POINTNET_WEIGHTS.with_name(CLASSIFIER), "fused", "fused.classifier")


def _require_shipped(path: Path, user: str, parameter: str) -> Path:
    if not path.is_file():
        raise InputError(f"the package has no weights for {user}; set {parameter} to a checkpoint")
    return path
