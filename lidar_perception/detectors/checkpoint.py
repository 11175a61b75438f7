"""Weights on disk, of any network: safetensors with a JSON header that says which they are of."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from lidar_perception.detectors.config_json import config_of
from lidar_perception.detectors.pointnet.config import PointNetConfig
from lidar_perception.detectors.pointpillars.config import NetworkConfig
from lidar_perception.runs.files import write_bytes
from lidar_perception.types import CLASSES, InputError

KEY = "lidar_perception"  # of the metadata, whose values are strings
FORMAT = 1
MOST = 100.0  # of a calibration's slopes and offsets
HEIGHT_APART = 0.3  # m between mounts from which on a cloud looks another


Net = TypeVar("Net", bound=torch.nn.Module)


class Config(Protocol):
    """What a network looks like, a dataclass. network: its name in NETWORKS."""

    network: ClassVar[str]

    @property
    def classes(self) -> tuple[str, ...]:
        """The names of what it detects."""

    @property
    def title(self) -> str:
        """Which one of its network it is."""


POINTPILLARS, POINTNET = NetworkConfig.network, PointNetConfig.network
NETWORKS: dict[str, tuple[str, str, type[Config]]] = {  # what it is, where it is used, its config
    POINTPILLARS: ("PointPillars", "the node pointpillars_detector and pointpillars.weights",
                   NetworkConfig),
    POINTNET: ("PointNet", "the node pointnet_detector and pointnet.weights", PointNetConfig),
}


@dataclass(frozen=True)
class Header:
    """What is known about weights. config: of the network; training: data, steps, time, seed;
    metrics: AP and the like, or empty; commit: of the code that trained them; calibration: what
    makes scores probabilities, see calibration.py, empty where they are the network's own. All of
    it can be JSON."""

    config: Any
    training: dict[str, Any] = field(default_factory=dict)
    metrics: dict[str, Any] = field(default_factory=dict)
    commit: str = ""
    calibration: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def network(self) -> str:
        """Its name in NETWORKS."""
        return self.config.network

    def unlike(self, height: float) -> str | None:
        """What to say where weights are used with a sensor so many metres above the ground, and
        that of their scans was elsewhere; None where that is not so, or nobody knows."""
        sensor = self.training.get("sensor")
        if not isinstance(sensor, dict) or not isinstance(sensor.get("height"), float) or (
                abs(sensor["height"] - height) < HEIGHT_APART):
            return None
        which = f"the sensor {sensor['name']}" if sensor.get("name") else "a sensor"
        return (f"trained for {which} at {sensor['height']:g} m, and used with one at {height:g} "
                "m")

    def text(self) -> str:
        """As JSON."""
        return json.dumps(dict(format=FORMAT, network=self.network,
                               config=dataclasses.asdict(self.config), training=self.training,
                               metrics=self.metrics, commit=self.commit,
                               calibration=self.calibration))

    @staticmethod
    def of_text(text: str | None, source: str, kind: type[Config] | None = None) -> Header:
        """The inverse of text. InputError naming source, also if its config is not of this
        kind."""
        content = _content(text, source)
        title, use, config = NETWORKS[content["network"]]
        if kind is not None and content["network"] != kind.network:
            wanted, own_use, _ = NETWORKS[kind.network]
            raise InputError(f"{source} holds a {title}, which is for {use}; {own_use} take a "
                             f"{wanted}")
        return Header(config_of(config, content["config"], source), content["training"],
                      content["metrics"], content["commit"], _lines(content["calibration"], source))


PARTS = {"config": dict, "training": dict, "metrics": dict, "commit": str}


def _content(text: str | None, source: str) -> dict[str, Any]:
    """The header's parts, all there, of a network that is known."""
    try:
        content = json.loads(text or "")
        parts = {name: content[name] for name in ("format", *PARTS)}
        network = content.get("network", POINTPILLARS)  # the first files had no such key
        calibration = content.get("calibration", {})
        if not all(isinstance(parts[name], kind) for name, kind in PARTS.items()):
            raise TypeError
    except (TypeError, ValueError, KeyError, AttributeError, RecursionError):
        raise InputError(f"{source} has no header of this package; use import-weights for "
                         "weights of other projects") from None
    if parts["format"] != FORMAT:
        raise InputError(f"{source} has format {str(parts['format'])[:40]}, this version reads "
                         f"{FORMAT}")
    if not isinstance(network, str) or network not in NETWORKS:
        raise InputError(f"{source} holds a network {str(network)[:40]!r}, this version knows "
                         f"{' and '.join(NETWORKS)}")
    return {"network": network, "calibration": calibration, **parts}


def _lines(content: Any, source: str) -> dict[str, tuple[float, float]]:
    """The calibration of a header. InputError where it is none."""
    try:
        lines = {name: (float(slope), float(offset)) for name, (slope, offset) in content.items()}
        if all(name in CLASSES and 0 < slope < MOST and abs(offset) < MOST
               for name, (slope, offset) in lines.items()):
            return lines
    except (TypeError, ValueError, AttributeError, OverflowError):
        pass
    raise InputError(f"{source} has a calibration that cannot be used; it needs a slope above 0 "
                     "and an offset for each class")


def network_of(path: str | Path) -> str:
    """Which network a checkpoint is of, a name of NETWORKS. InputError if it cannot be read."""
    return _content(_read(Path(path), tensors=False)[0], str(path))["network"]


def save_checkpoint(path: str | Path, network: torch.nn.Module, header: Header,
                    half: bool = False) -> None:
    """Write the network's weights and header, so that path holds the old file or the whole new
    one. half stores the weights of layers as float16; norms and biases stay float32."""
    tensors = {name: _stored(value, half) for name, value in network.state_dict().items()}
    write_bytes(path, save(tensors, {KEY: header.text()}))


def save_header(path: Path, header: Header) -> None:
    """Write another header into a checkpoint, whose tensors stay as they are stored."""
    write_bytes(path, save(_read(path)[1], {KEY: header.text()}))


def _stored(value: torch.Tensor, half: bool) -> torch.Tensor:
    value = value.detach().cpu()
    if value.is_floating_point():
        value = value.to(torch.float16 if half and value.ndim > 1 else torch.float32)
    return value.contiguous()


def read_header(path: str | Path, kind: type[Config] | None = None) -> Header:
    """The header alone. InputError for a file that is missing, broken or without one, or whose
    config is not of this kind."""
    return Header.of_text(_read(Path(path), tensors=False)[0], str(path), kind)


def read(path: str | Path, kind: type[Config]) -> tuple[Header, dict[str, torch.Tensor]]:
    """Header, and the tensors as they are stored, on the CPU. InputError as read_header."""
    text, tensors = _read(Path(path))
    return Header.of_text(text, str(path), kind), tensors


def load(path: str | Path, kind: type[Config], make: Callable[[Any], Net],
         expected: Any = None) -> tuple[Header, Net]:
    """Header, and the network that make(config) gives with the weights of the file: float32 on the
    CPU, in training mode. InputError as read_header, where the weights do not fit, and where the
    config is another than expected."""
    header, tensors = read(path, kind)
    if expected is not None:
        require_same(header.config, expected, str(path))
    with torch.device("meta"):  # shapes alone: the header takes no memory before they fit
        wanted = make(header.config).state_dict()
    for name in sorted({*wanted, *tensors}, key=str):
        ours, theirs = (_described(state.get(name)) for state in (wanted, tensors))
        if ours != theirs:
            raise InputError(f"the weights in {path} do not fit its header: {name[:80]} is "
                             f"{theirs}, and should be {ours}")
    network = make(header.config)
    network.load_state_dict({name: value.to(wanted[name].dtype)
                             for name, value in tensors.items()})
    return header, network


def _described(value: torch.Tensor | None) -> str:
    if value is None:
        return "not there"
    kind = "floats" if value.is_floating_point() else str(value.dtype).removeprefix("torch.")
    return f"{kind} of shape {tuple(value.shape)}"


def adopt(network: torch.nn.Module, path: str | Path, kind: type[Config]) -> tuple[int, int]:
    """Begin with the weights of a checkpoint of a network of this kind, of any config: each layer
    of the same name and shape is taken, of one with other inputs those that both have (new ones
    begin at 0); the rest stays as it is. How many tensors were taken, and of how many.
    InputError as read, and where nothing fits."""
    _, tensors = read(path, kind)
    state = network.state_dict()
    taken = 0
    for name, value in state.items():
        found = tensors.get(name)
        if found is None or found.ndim != value.ndim:
            continue
        if found.shape == value.shape:
            value.copy_(found)
        elif value.ndim > 1 and found.shape[0] == value.shape[0] and (
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


def require_same(found: Any, wanted: Any, source: str) -> None:
    """InputError naming the first fields in which two configs differ, with both values."""
    ours, theirs = dataclasses.asdict(wanted), dataclasses.asdict(found)
    different = [name for name in ours if ours[name] != theirs[name]]
    if different:
        shown = "; ".join(f"{name} is {theirs[name]}, asked for was {ours[name]}"
                          for name in different[:3])
        raise InputError(f"{source} holds another network: {shown}")


def _read(path: Path, tensors: bool = True) -> tuple[str | None, dict[str, torch.Tensor]]:
    """The header's text, None if there is none, and the tensors."""
    if not path.is_file():
        raise InputError(f"there is no checkpoint {path}")
    try:
        with safe_open(path, "pt") as opened:
            text = (opened.metadata() or {}).get(KEY)
            names = opened.keys() if tensors and text else ()
            return text, {name: opened.get_tensor(name) for name in names}
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path} is no checkpoint, or was cut short: {error}") from None
