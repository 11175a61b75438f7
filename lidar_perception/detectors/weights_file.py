"""Paths of the weights of PointPillars and PointNet, without importing torch."""

from __future__ import annotations

from pathlib import Path

from lidar_perception.detectors.pointnet.params import PointNetParams
from lidar_perception.detectors.pointpillars.params import PointPillarsParams
from lidar_perception.types import InputError

POINTPILLARS_WEIGHTS = Path(__file__).parent / "pointpillars" / "weights"  # folder with one file per version and size
POINTNET_WEIGHTS = Path(__file__).parent / "pointnet" / "weights" / "pointnet.safetensors"
PROPOSER = "pointpillars_v4_compact_nine_sensors.safetensors"  # weights of fused, in POINTPILLARS_WEIGHTS
JUDGE = "judge.safetensors"  # file name of the weights that classify boxes of other detectors, beside POINTNET_WEIGHTS


def require_weights(path: str, parameter: str) -> Path:
    """Return the path of a file of weights. InputError that names `parameter` if it does not exist."""
    if not Path(path).is_file():
        raise InputError(f"there is no checkpoint {path}; set {parameter} to an existing file")
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
    """Return the PointPillars weights of `fused`, trained on nine sensors. InputError if missing."""
    return _require_shipped(POINTPILLARS_WEIGHTS / PROPOSER, "fused", "fused.weights")


def find_pointnet_weights(params: PointNetParams) -> Path:
    """Return `params.weights`, by default the shipped file. InputError if it does not exist."""
    if params.weights:
        return require_weights(params.weights, "pointnet.weights")
    return _require_shipped(POINTNET_WEIGHTS, "PointNet", "pointnet.weights")


def find_judge_weights() -> Path:
    """Return the weights trained to classify boxes of other detectors. InputError if missing."""
    return _require_shipped(POINTNET_WEIGHTS.with_name(JUDGE), "fused", "fused.classifier")


def _require_shipped(path: Path, user: str, parameter: str) -> Path:
    if not path.is_file():
        raise InputError(f"the package has no weights for {user}; set {parameter} to a checkpoint")
    return path
