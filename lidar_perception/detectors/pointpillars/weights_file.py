"""Path of the weights of PointPillars, without loading torch."""

from __future__ import annotations

from pathlib import Path

from lidar_perception.detectors.pointpillars.params import PointPillarsParams
from lidar_perception.detectors.weights_file import require_weights
from lidar_perception.types import InputError

WEIGHTS = Path(__file__).parent / "weights"


def weights_file(params: PointPillarsParams) -> Path:
    """Return `params.weights`, by default the shipped file for the version and size in `params`.

    Raises:
        InputError: the file does not exist.
    """
    if params.weights:
        return require_weights(params.weights, "pointpillars.weights")
    version = "v4" if params.version == "auto" else params.version
    size = "compact" if params.size == "auto" else params.size
    path = WEIGHTS / f"pointpillars_{version}_{size}.safetensors"
    if not path.is_file():
        raise InputError(f"the package has no weights for {version} {size}; set pointpillars.weights to a checkpoint")
    return path
