"""Check of the file that a parameter names, without loading torch."""

from __future__ import annotations

from pathlib import Path

from lidar_perception.types import InputError


def require_weights(path: str, parameter: str) -> Path:
    """Return the path of a file of weights.

    Raises:
        InputError: the file does not exist.
    """
    if not Path(path).is_file():
        raise InputError(f"there is no checkpoint {path}; set {parameter} to an existing file")
    return Path(path)
