"""Where the weights are, found without loading torch."""

from __future__ import annotations

from pathlib import Path

from lidar_perception.detectors.pointnet.params import PointNetParams
from lidar_perception.detectors.weights_file import require_weights
from lidar_perception.types import InputError

WEIGHTS = Path(__file__).parent / "weights" / "pointnet.safetensors"
JUDGE = "judge.safetensors"  # beside it


def weights_file(params: PointNetParams) -> Path:
    """The file that params name, or else the one that comes with the package. InputError if it is
    not there."""
    if params.weights:
        return require_weights(params.weights, "pointnet.weights")
    return _shipped(WEIGHTS)


def find_judge_weights() -> Path:
    """Those that were trained to judge the boxes of other detectors. InputError likewise."""
    return _shipped(WEIGHTS.with_name(JUDGE))


def _shipped(path: Path) -> Path:
    if not path.is_file():
        raise InputError("no PointNet weights come with the package; name a checkpoint with "
                         "pointnet.weights")
    return path
