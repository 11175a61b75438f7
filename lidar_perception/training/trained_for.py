"""Which sensor and scenes weights were trained for, by their header."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from lidar_perception.detectors.checkpoint import Header
from lidar_perception.training.params import AsTrained
from lidar_perception.types import InputError

HDL, STREET = "hdl64e", "street"  # of weights that do not say

Asked = TypeVar("Asked", bound=AsTrained)


def as_trained(params: Asked, header: Header) -> Asked:
    """The params, their sensor and scene those of a header where they are empty. InputError where
    the file of that sensor is not there."""
    sensor, given = _sensor(header), header.training.get("params")
    name = sensor.get("name") or HDL
    if not params.sensor and Path(name).suffix in (".yaml", ".yml") and not Path(name).is_file():
        raise InputError(f"the weights are for the sensor {name}, which is not there; say where it "
                         "is, or what sensor this is, with --sensor")
    return replace(
        params, sensor=params.sensor or name,
        scene=params.scene or (given.get("scene") if isinstance(given, dict) else "") or STREET)


def trained_height(header: Header) -> float:
    """Metres of the sensor above the ground, 0 where the header does not say."""
    height = _sensor(header).get("height")
    return height if isinstance(height, float) else 0.0


def _sensor(header: Header) -> dict[str, Any]:
    sensor = header.training.get("sensor")
    return sensor if isinstance(sensor, dict) else {}
