"""Paths of the weights of PointNet, without loading torch."""

from __future__ import annotations

from pathlib import Path

from lidar_perception.detectors.pointnet.params import PointNetParams
from lidar_perception.detectors.weights_file import require_weights
from lidar_perception.types import InputError

WEIGHTS = Path(__file__).parent / "weights" / "pointnet.safetensors"
JUDGE = "judge.safetensors"  # file name of the judge's weights, in the same folder


def weights_file(params: PointNetParams) -> Path:
    """Return `params.weights`, by default the shipped file. InputError if it does not exist."""
    if params.weights:
        return require_weights(params.weights, "pointnet.weights")
    return _shipped(WEIGHTS)


def find_judge_weights() -> Path:
    """Return the weights trained to classify boxes of other detectors. InputError if missing."""
    return _shipped(WEIGHTS.with_name(JUDGE))


def _shipped(path: Path) -> Path:
    if not path.is_file():
        raise InputError("the package has no PointNet weights; set pointnet.weights to a checkpoint")
    return path
