"""Weights on disk: safetensors with a JSON header that says which network they are of."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from lidar_perception.detection.config import NetworkConfig, from_json, require_same, to_json
from lidar_perception.detection.pointpillars import PointPillars, make_network
from lidar_perception.files import write_bytes
from lidar_perception.types import InputError

KEY = "lidar_perception"  # of the metadata, whose values are strings
FORMAT = 1


@dataclass(frozen=True)
class Header:
    """What is known about weights. training: data, steps, time, seed; metrics: AP and the like, or
    empty; commit: of the code that trained them. All of it can be JSON."""

    config: NetworkConfig
    training: dict[str, Any] = field(default_factory=dict)
    metrics: dict[str, Any] = field(default_factory=dict)
    commit: str = ""

    def text(self) -> str:
        """As JSON."""
        return json.dumps(dict(format=FORMAT, config=to_json(self.config), training=self.training,
                               metrics=self.metrics, commit=self.commit))

    @staticmethod
    def of_text(text: str | None, source: str) -> Header:
        """The inverse of text. InputError naming source."""
        try:
            content = json.loads(text)
            made = content["format"]
            if made != FORMAT:
                raise InputError(f"{source} has format {made}, this version reads {FORMAT}")
            return Header(from_json(content["config"], source), content["training"],
                          content["metrics"], content["commit"])
        except InputError:
            raise
        except (TypeError, ValueError, KeyError):
            raise InputError(f"{source} has no header of this package; use import-weights for "
                             "weights of other projects") from None


def save_checkpoint(path: str | Path, network: PointPillars, header: Header,
                    half: bool = False) -> None:
    """Write the network's weights and header, so that path holds the old file or the whole new
    one. half stores the weights of layers as float16; norms and biases stay float32."""
    tensors = {name: _stored(value, half) for name, value in network.state_dict().items()}
    write_bytes(path, save(tensors, {KEY: header.text()}))


def _stored(value: torch.Tensor, half: bool) -> torch.Tensor:
    value = value.detach().cpu()
    if value.is_floating_point():
        value = value.to(torch.float16 if half and value.ndim > 1 else torch.float32)
    return value.contiguous()


def read_header(path: str | Path) -> Header:
    """The header alone. InputError for a file that is missing, broken or without one."""
    return _read(Path(path))[0]


def load_network(path: str | Path,
                 expected: NetworkConfig | None = None) -> tuple[Header, PointPillars]:
    """Header and network, in float32 on the CPU, in training mode. InputError if the file cannot
    be used, or holds another network than expected."""
    header, tensors = _read(Path(path), weights=True)
    if expected is not None:
        require_same(header.config, expected, str(path))
    network = make_network(header.config)
    state = {name: value.float() if value.is_floating_point() else value
             for name, value in tensors.items()}
    try:
        network.load_state_dict(state)
    except RuntimeError as error:
        reason = str(error).splitlines()[1:2] or [str(error)]
        raise InputError(f"the weights in {path} do not fit its header: {reason[0].strip()}"
                         ) from None
    return header, network


def adopt(network: PointPillars, path: str | Path) -> tuple[int, int]:
    """Begin with the weights of a checkpoint of any version, size and classes: each layer of the
    same name and shape is taken, of a convolution with other inputs those that both have (new ones
    begin at 0); the rest stays as it is. How many tensors were taken, and of how many. InputError
    as load_network, and where nothing fits."""
    _, tensors = _read(Path(path), weights=True)
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


def _read(path: Path, weights: bool = False) -> tuple[Header, dict[str, torch.Tensor]]:
    if not path.is_file():
        raise InputError(f"there is no checkpoint {path}")
    try:
        with safe_open(path, "pt") as opened:
            text = (opened.metadata() or {}).get(KEY)
            header = Header.of_text(text, str(path))
            names = opened.keys() if weights else ()
            return header, {name: opened.get_tensor(name) for name in names}
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path} is no checkpoint, or was cut short: {error}") from None
