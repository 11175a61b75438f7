"""PointPillars weights on disk; the format is that of lidar_perception/detectors/checkpoint.py."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lidar_perception.detectors import checkpoint
from lidar_perception.detectors.checkpoint import KEY, POINTPILLARS, save_checkpoint
from lidar_perception.detectors.pointpillars.config import NetworkConfig, from_json
from lidar_perception.detectors.pointpillars.network import PointPillars, make_network

__all__ = ["KEY", "Header", "load_network", "read_header", "save_checkpoint"]


@dataclass(frozen=True)
class Header(checkpoint.Header):
    """What is known about PointPillars weights."""

    network = POINTPILLARS
    read_config = staticmethod(from_json)

    config: NetworkConfig


def read_header(path: str | Path) -> Header:
    """The header alone. InputError for a file that is missing, broken, without one, or of another
    network."""
    return checkpoint.read_header(path, Header)


def load_network(path: str | Path,
                 expected: NetworkConfig | None = None) -> tuple[Header, PointPillars]:
    """Header and network, in float32 on the CPU, in training mode. InputError if the file cannot
    be used, or holds another network than expected."""
    return checkpoint.load(path, Header, make_network, expected)
