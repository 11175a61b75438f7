"""PointPillars weights on disk; the format is that of lidar_perception/checkpoint.py."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lidar_perception import checkpoint
from lidar_perception.checkpoint import KEY, POINTPILLARS, save_checkpoint
from lidar_perception.detection.config import NetworkConfig, from_json
from lidar_perception.detection.pointpillars import PointPillars, make_network
from lidar_perception.types import InputError

__all__ = ["KEY", "Header", "adopt", "load_network", "read_header", "save_checkpoint"]


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


def adopt(network: PointPillars, path: str | Path) -> tuple[int, int]:
    """Begin with the weights of a checkpoint of any version, size and classes: each layer of the
    same name and shape is taken, of a convolution with other inputs those that both have (new ones
    begin at 0); the rest stays as it is. How many tensors were taken, and of how many. InputError
    as load_network, and where nothing fits."""
    _, tensors = checkpoint.read(path, Header)
    state = network.state_dict()
    taken = 0
    for name, value in state.items():
        found = tensors.get(name)
        if found is None or found.ndim != value.ndim:
            continue
        if found.shape == value.shape:
            value.copy_(found)
        elif value.ndim == 4 and found.shape[0] == value.shape[0] and (
                found.shape[2:] == value.shape[2:]):
            common = min(found.shape[1], value.shape[1])
            value.zero_()
            value[:, :common] = found[:, :common]
        else:
            continue
        taken += 1
    if not taken:
        raise InputError(f"no layer of {path} fits the network that is to be trained")
    return taken, len(state)
