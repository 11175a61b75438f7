"""A checkpoint that a parameter names, found without loading torch."""

from __future__ import annotations

from pathlib import Path

from lidar_perception.types import InputError


def existing(path: str, parameter: str) -> Path:
    """The file at path. InputError naming the parameter if there is none."""
    if not Path(path).is_file():
        raise InputError(f"there is no checkpoint {path}; name another with {parameter}")
    return Path(path)
