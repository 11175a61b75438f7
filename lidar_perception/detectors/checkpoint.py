"""Checkpoints of all networks: safetensors files with a JSON header that describes the network.

Reading headers does not import torch.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeVar

import numpy as np
from safetensors import SafetensorError, safe_open

from lidar_perception.detectors.config_json import parse_config
from lidar_perception.detectors.layer_weights import WeightsMismatch
from lidar_perception.detectors.pointnet.config import PointNetConfig
from lidar_perception.detectors.pointpillars.config import NetworkConfig
from lidar_perception.runs.files import write_bytes
from lidar_perception.types import CLASSES, InputError

KEY = "lidar_perception"  # metadata key of the header, a JSON string
FORMAT = 1
MAX_COEFFICIENT = 100.0  # maximum absolute value of a slope or offset of a calibration
MIN_HEIGHT_DIFFERENCE_M = 0.3  # minimum difference in mounting height for a warning

if TYPE_CHECKING:
    import torch

Net = TypeVar("Net", bound="torch.nn.Module")


class Config(Protocol):
    """Dataclass that describes a network; `network` is a key in NETWORKS."""

    network: ClassVar[str]

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the detectable classes."""

    @property
    def title(self) -> str:
        """Name of the network variant."""


POINTPILLARS, POINTNET = NetworkConfig.network, PointNetConfig.network
NETWORKS: dict[str, tuple[str, str, type[Config]]] = {  # key -> (title, use, config type)
    POINTPILLARS: ("PointPillars", "the node pointpillars_detector and pointpillars.weights", NetworkConfig),
    POINTNET: ("PointNet", "the node pointnet_detector and pointnet.weights", PointNetConfig),
}


@dataclass(frozen=True)
class Header:
    """Metadata of a checkpoint; all values are JSON serializable.

    Attributes:
        config: network config.
        training: data, steps, duration and seed of the training.
        metrics: AP and other scores; may be empty.
        commit: git commit of the training code.
        calibration: lines by class, see calibration.py; empty for raw scores.
    """

    config: Any
    training: dict[str, Any] = field(default_factory=dict)
    metrics: dict[str, Any] = field(default_factory=dict)
    commit: str = ""
    calibration: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def network(self) -> str:
        """Key of the network in NETWORKS."""
        return self.config.network

    def find_height_mismatch(self, height: float) -> str | None:
        """Return a warning if the weights were trained for a sensor height other than `height` metres.

        It is None if the heights agree or the height in training is unknown.
        """
        sensor = self.training.get("sensor")
        if (
            not isinstance(sensor, dict)
            or not isinstance(sensor.get("height"), float)
            or abs(sensor["height"] - height) < MIN_HEIGHT_DIFFERENCE_M
        ):
            return None
        sensor_text = f"the sensor {sensor['name']}" if sensor.get("name") else "a sensor"
        return f"trained for {sensor_text} at {sensor['height']:g} m, but used with a sensor at {height:g} m"

    def to_json(self) -> str:
        """Return the header as JSON text."""
        return json.dumps({"format": FORMAT, "network": self.network, **dataclasses.asdict(self)})

    @staticmethod
    def from_json(text: str | None, source: str, config_class: type[Config] | None = None) -> Header:
        """Read a header from JSON text, the inverse of to_json.

        Args:
            source: name of the file, for messages.
            config_class: config type that the header must have; None: any.

        Raises:
            InputError: the text is not a header, or its config has a different type.
        """
        content = _parse_header(text, source)
        title, use, config = NETWORKS[content["network"]]
        if config_class is not None and content["network"] != config_class.network:
            expected_title, expected_use, _ = NETWORKS[config_class.network]
            raise InputError(
                f"{source} contains a {title} network for {use}; {expected_use} require a {expected_title} network"
            )
        return Header(
            parse_config(config, content["config"], source),
            content["training"],
            content["metrics"],
            content["commit"],
            _parse_calibration(content["calibration"], source),
        )


FIELD_TYPES = {"config": dict, "training": dict, "metrics": dict, "commit": str}  # required fields of a header


def _parse_header(text: str | None, source: str) -> dict[str, Any]:
    """Parse a header and check its fields and its network."""
    try:
        content = json.loads(text or "")
        fields = {name: content[name] for name in ("format", *FIELD_TYPES)}
        network = content.get("network", POINTPILLARS)  # missing in files of early versions
        calibration = content.get("calibration", {})
        if not all(isinstance(fields[name], field_type) for name, field_type in FIELD_TYPES.items()):
            raise TypeError
    except (TypeError, ValueError, KeyError, AttributeError, RecursionError):
        raise InputError(
            f"{source} has no lidar_perception header; convert weights of other projects with import-weights"
        ) from None
    if fields["format"] != FORMAT:
        raise InputError(
            f"{source} has format version {str(fields['format'])[:40]}, but only version {FORMAT} is supported"
        )
    if not isinstance(network, str) or network not in NETWORKS:
        raise InputError(
            f"{source} contains the unknown network {str(network)[:40]!r}; supported: {', '.join(NETWORKS)}"
        )
    return {"network": network, "calibration": calibration, **fields}


def _parse_calibration(content: Any, source: str) -> dict[str, tuple[float, float]]:
    try:
        lines = {name: (float(slope), float(offset)) for name, (slope, offset) in content.items()}
        if all(
            name in CLASSES and 0 < slope < MAX_COEFFICIENT and abs(offset) < MAX_COEFFICIENT
            for name, (slope, offset) in lines.items()
        ):
            return lines
    except (TypeError, ValueError, AttributeError, OverflowError):
        pass
    raise InputError(f"{source} has an invalid calibration; expected a slope above 0 and an offset for each class")


def save_checkpoint(path: str | Path, network: torch.nn.Module, header: Header, half: bool = False) -> None:
    """Write the weights and the header of a network atomically.

    Args:
        half: store layer weights as float16; norms and biases remain float32.
    """
    from safetensors.torch import save

    tensors = {name: _convert_to_stored(value, half) for name, value in network.state_dict().items()}
    write_bytes(path, save(tensors, {KEY: header.to_json()}))


def save_header(path: Path, header: Header) -> None:
    """Replace the header of a checkpoint; the tensors remain unchanged."""
    from safetensors.torch import save

    write_bytes(path, save(_read(path)[1], {KEY: header.to_json()}))


def _convert_to_stored(value: torch.Tensor, half: bool) -> torch.Tensor:
    import torch

    value = value.detach().cpu()
    if value.is_floating_point():
        value = value.to(torch.float16 if half and value.ndim > 1 else torch.float32)
    return value.contiguous()


def read_header(path: str | Path, config_class: type[Config] | None = None) -> Header:
    """Read the header of a checkpoint.

    Args:
        config_class: config type that the checkpoint must have; None: any.

    Raises:
        InputError: the file is missing or damaged, or has no header, or its config has a different
            type.
    """
    return Header.from_json(_read(Path(path), tensors=False)[0], str(path), config_class)


def read_checkpoint(path: str | Path, config_class: type[Config]) -> tuple[Header, dict[str, torch.Tensor]]:
    """Read the header and the tensors as torch tensors on the CPU, with the dtypes of the file.

    Raises:
        InputError: see read_header.
    """
    text, tensors = _read(Path(path))
    return Header.from_json(text, str(path), config_class), tensors


def read_arrays(path: str | Path, config_class: type[Config]) -> tuple[Header, dict[str, np.ndarray]]:
    """Read the header and the tensors as NumPy arrays, with the dtypes of the file, without importing torch.

    Raises:
        InputError: see read_header.
        WeightsMismatch: a tensor has a number format that NumPy does not support, such as bf16.
    """
    try:
        text, tensors = _read(Path(path), framework="np")
    except (TypeError, AttributeError) as error:  # raised by safetensors
        raise WeightsMismatch(str(error)) from None
    return Header.from_json(text, str(path), config_class), tensors


def load_checkpoint(
    path: str | Path, config_class: type[Config], make: Callable[[Any], Net], expected: Any = None
) -> tuple[Header, Net]:
    """Load the header and the network of a checkpoint, in float32, on the CPU and in training mode.

    Args:
        config_class: config type that the checkpoint must have.
        make: function that makes an untrained network from a config.
        expected: config that the checkpoint must have; None: any.

    Raises:
        InputError: see read_header and require_same_config, or the weights do not fit the config.
    """
    import torch

    header, tensors = read_checkpoint(path, config_class)
    if expected is not None:
        require_same_config(header.config, expected, str(path))
    with torch.device("meta"):  # shapes only, to check them before allocating memory
        state_dict = make(header.config).state_dict()
    for name in sorted({*state_dict, *tensors}, key=str):
        required, actual = (_describe_tensor(state.get(name)) for state in (state_dict, tensors))
        if required != actual:
            raise InputError(
                f"the weights in {path} do not match its header: {name[:80]} is {actual}, expected {required}"
            )
    network = make(header.config)
    network.load_state_dict({name: value.to(state_dict[name].dtype) for name, value in tensors.items()})
    return header, network


def _describe_tensor(value: torch.Tensor | None) -> str:
    if value is None:
        return "missing"
    number_type = "floats" if value.is_floating_point() else str(value.dtype).removeprefix("torch.")
    return f"{number_type} of shape {tuple(value.shape)}"


def copy_matching_weights(network: torch.nn.Module, path: str | Path, config_class: type[Config]) -> tuple[int, int]:
    """Initialize a network for fine-tuning with the matching weights of a checkpoint; configs may differ.

    Tensors with the same name and shape are copied. If only the number of inputs differs, the
    common inputs are copied and new inputs are set to 0. All other tensors remain unchanged.

    Args:
        config_class: config type that the checkpoint must have.

    Returns:
        Number of copied tensors, and total number of tensors of the network.

    Raises:
        InputError: see read_header, or no tensor matches.
    """
    _, tensors = read_checkpoint(path, config_class)
    state = network.state_dict()
    copied_count = 0
    for name, value in state.items():
        stored_tensor = tensors.get(name)
        if stored_tensor is None or stored_tensor.ndim != value.ndim:
            continue
        if stored_tensor.shape == value.shape:
            value.copy_(stored_tensor)
        elif (
            value.ndim > 1 and stored_tensor.shape[0] == value.shape[0] and (stored_tensor.shape[2:] == value.shape[2:])
        ):
            common_inputs = min(stored_tensor.shape[1], value.shape[1])
            value.zero_()
            value[:, :common_inputs] = stored_tensor[:, :common_inputs]
        else:
            continue
        copied_count += 1
    if not copied_count:
        raise InputError(f"no layer in {path} matches the network to train")
    return copied_count, len(state)


def require_same_config(config: Any, expected: Any, source: str) -> None:
    """Raise an InputError that lists the first fields in which two configs differ."""
    required, actual = dataclasses.asdict(expected), dataclasses.asdict(config)
    different_names = [name for name in required if required[name] != actual[name]]
    if different_names:
        fields = "; ".join(f"{name} is {actual[name]}, expected {required[name]}" for name in different_names[:3])
        raise InputError(f"{source} contains a different network: {fields}")


def _read(path: Path, tensors: bool = True, framework: str = "pt") -> tuple[str | None, dict[str, Any]]:
    """Return the text of the header (None if missing) and the tensors.

    Args:
        framework: type of the tensors: pt (torch) or np (NumPy).
    """
    if not path.is_file():
        raise InputError(f"checkpoint not found: {path}")
    try:
        with safe_open(path, framework if tensors else "np") as file:
            text = (file.metadata() or {}).get(KEY)
            names = file.keys() if tensors and text else ()
            return text, {name: file.get_tensor(name) for name in names}
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path} is not a checkpoint, or is truncated: {error}") from None
