"""Where the weights are, found without loading torch."""

from __future__ import annotations

from pathlib import Path

from lidar_perception.detectors.pointpillars.params import PointPillarsParams
from lidar_perception.detectors.weights_file import require_weights
from lidar_perception.types import InputError

WEIGHTS = Path(__file__).parent / "weights"


def weights_file(params: PointPillarsParams) -> Path:
    """The file that params name, or else the one that comes with the package for their version and
    size. InputError if it is not there."""
    if params.weights:
        return require_weights(params.weights, "pointpillars.weights")
    version = "v4" if params.version == "auto" else params.version
    size = "compact" if params.size == "auto" else params.size
    path = WEIGHTS / f"pointpillars_{version}_{size}.safetensors"
    if not path.is_file():
        raise InputError(f"no weights for {version} {size} come with the package; name a "
                         "checkpoint with pointpillars.weights")
    return path
