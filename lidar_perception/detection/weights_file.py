"""Where the weights are, found without loading torch."""

from __future__ import annotations

from pathlib import Path

from lidar_perception.detection.detector_params import DetectionParams
from lidar_perception.types import InputError

WEIGHTS = Path(__file__).parent / "weights"


def existing(path: str, parameter: str) -> Path:
    """The file at path. InputError naming the parameter if there is none."""
    if not Path(path).is_file():
        raise InputError(f"there is no checkpoint {path}; name another with {parameter}")
    return Path(path)


def weights_file(params: DetectionParams) -> Path:
    """The file that params name, or else the one that comes with the package for their version and
    size. InputError if it is not there."""
    if params.weights:
        return existing(params.weights, "detection.weights")
    version = "v4" if params.version == "auto" else params.version
    size = "compact" if params.size == "auto" else params.size
    path = WEIGHTS / f"pointpillars_{version}_{size}.safetensors"
    if not path.is_file():
        raise InputError(f"no weights for {version} {size} come with the package; name a "
                         "checkpoint with detection.weights")
    return path
