"""PointNet weights on disk; the format is that of lidar_perception/detectors/checkpoint.py."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torch import nn

from lidar_perception.detectors import checkpoint
from lidar_perception.detectors.checkpoint import POINTNET, save_checkpoint
from lidar_perception.detectors.pointnet.config import PointNetConfig, from_json
from lidar_perception.detectors.pointnet.network import make_pointnet

__all__ = ["Header", "load_pointnet", "read_header", "save_checkpoint"]


@dataclass(frozen=True)
class Header(checkpoint.Header):
    """What is known about PointNet weights."""

    network = POINTNET
    read_config = staticmethod(from_json)

    config: PointNetConfig


def read_header(path: str | Path) -> Header:
    """The header alone. InputError for a file that is missing, broken, without one, or of another
    network."""
    return checkpoint.read_header(path, Header)


def load_pointnet(path: str | Path,
                  expected: PointNetConfig | None = None) -> tuple[Header, nn.Module]:
    """Header and network, in float32 on the CPU, in training mode. InputError if the file cannot
    be used, or holds another network than expected."""
    return checkpoint.load(path, Header, make_pointnet, expected)
