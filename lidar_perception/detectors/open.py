"""Opening of detectors by name or from a file of weights. Importing this module does not import torch."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self

from lidar_perception.detectors.contract import FUSED, Detector
from lidar_perception.detectors.custom import (
    CustomDetectorParams,
    entry_point_names,
    find_reference,
    load_custom_detector,
)
from lidar_perception.detectors.params import RANGE_CHOICES
from lidar_perception.ground.params import set_sensor_height
from lidar_perception.param_fields import with_values
from lidar_perception.runs.compiling import report_compilation
from lidar_perception.types import InputError, make_unknown_name_error

if TYPE_CHECKING:
    from lidar_perception.detectors.checkpoint import Header

POINTPILLARS, POINTNET = "pointpillars", "pointnet"

# Each detector's function load(path, device) in this folder. An empty path selects the shipped
# weights. Detectors with an entry in PARAMS get these parameters as a third argument.
LOAD = {
    POINTPILLARS: "pointpillars.detector.load_detector",
    POINTNET: "pointnet.detector.load_pointnet_detector",
    FUSED: "fused.detector.load_fused_detector",
}
PARAMS = {
    POINTPILLARS: "pointpillars.params.DetectorParams",
    POINTNET: "pointnet.params.PointNetDetectorParams",
    FUSED: "fused.params.FusedDetectorParams",
}
CHECKPOINT_SUFFIX, ONNX_SUFFIX, FUSION_SUFFIX = ".safetensors", ".onnx", ".json"


class ConfigurableDetector(Detector, Protocol):
    """A detector whose `params` are the parameters of its node, a dataclass."""

    params: Any

    def with_params(self, params: Any) -> Self:
        """Return a copy of this detector with different parameters."""

    def with_range(self, range: str) -> Self:
        """Return a copy of this detector with a different range, see base.NetworkDetector."""


@report_compilation(full_detector=True)
def open_detector(
    weights: str | Path = FUSED,
    device: str = "auto",
    *,
    sensor_height: float | None = None,
    min_score: float | None = None,
    range: str = "auto",
    settings: Mapping[str, Any] = {},
) -> ConfigurableDetector:
    """Open a detector by its name or from a file of weights.

    The first call on a machine compiles Numba functions, which takes a minute or two and is
    reported on standard error.

    Args:
        weights: name of a detector, or a file of weights, see api.load_detector.
        device: auto, cpu, cuda or cuda:N.
        sensor_height: height of the sensor above the ground in metres; None: 1.73 m, as in KITTI.
        min_score: score threshold of all classes, 0..1; None: the defaults.
        range: ahead, around, or auto (the range the network was trained for).
        settings: other parameters by their dotted names, such as {"fused.scores.car": 0.7}. They
            take precedence over the arguments above.

    Raises:
        InputError: the file cannot be used, the detector cannot cover that range, the device does
            not exist, or a parameter is unknown or out of range.
    """
    if range not in RANGE_CHOICES:
        raise make_unknown_name_error("range", range, RANGE_CHOICES)
    name, path = resolve_weights(weights)
    reference = None if name in LOAD else find_reference(name)
    arguments = {} if device == "auto" else {f"{name}.device": device}
    if range != "auto" and name != POINTNET:
        arguments[f"{name}.range"] = range
    if path is not None and f"{name}.weights" in settings:
        raise InputError(f"both {name}.weights and {path} are given; give only one of them")
    try:
        if reference is not None:
            custom_params = (
                CustomDetectorParams()
                if sensor_height is None
                else set_sensor_height(CustomDetectorParams(), sensor_height)
            )
            detector: Any = load_custom_detector(reference, device, range, custom_params)
        elif name in PARAMS:
            weights_param = settings.get("pointnet.weights") if name == POINTNET else None
            params = with_values(make_default_params(weights_param or weights), {**arguments, **settings})
            detector = _find_loader(name)(path or "", getattr(params, name).device, params)
        else:
            detector = _find_loader(name)(path or "", device)
        if reference is None and range != "auto" and f"{name}.range" not in settings:
            detector = detector.with_range(range)
        if sensor_height is not None:
            detector = detector.with_sensor_height(sensor_height)
        if min_score is not None:
            detector = detector.with_min_score(min_score)
        if settings:
            detector = detector.with_params(with_values(detector.params, settings))
    except ValueError as error:
        raise InputError(str(error)) from None
    return detector


def make_default_params(weights: str | Path) -> Any:
    """Make the default parameters of a detector, a dataclass of groups.

    PointNet gets the ground and clustering parameters that it was trained with.

    Args:
        weights: name of a detector, or file of its weights.

    Raises:
        InputError: there is no such detector or file.
    """
    name, path = resolve_weights(weights)
    if name not in LOAD:
        return CustomDetectorParams()
    if name not in PARAMS:
        return open_detector(weights).params
    params = _import_attribute(PARAMS[name])()
    return _apply_training_params(params, path) if name == POINTNET else params


def _find_loader(name: str) -> Callable[..., ConfigurableDetector]:
    return _import_attribute(LOAD[name])


def _import_attribute(path: str) -> Any:
    """Import `module.attribute` from this folder."""
    return getattr(importlib.import_module(_get_module_name(path)), path.rpartition(".")[2])


def _get_module_name(path: str) -> str:
    return f"lidar_perception.detectors.{path.rpartition('.')[0]}"


def _apply_training_params(params: Any, path: Path | None) -> Any:
    from lidar_perception.detectors.weights_file import find_pointnet_weights

    try:
        config = _read_header(path or find_pointnet_weights(params.pointnet)).config
    except InputError:
        if path is not None:
            raise
        return params  # open_detector reports the missing weights
    return replace(params, ground=config.ground, clustering=config.clustering)


def resolve_weights(weights: str | Path) -> tuple[str, Path | None]:
    """Return the detector's name and the file of its weights.

    The file is None for shipped weights and for custom detectors.

    Args:
        weights: detector name, custom class or file.

    Raises:
        InputError: `weights` is not a detector, a class or a file of weights.
    """
    name, path = str(weights), Path(weights)
    if name in LOAD or (not path.exists() and find_reference(name)):
        return name, None
    if path.name == name and not path.suffix and not path.exists():
        raise make_unknown_name_error("detector or file of weights", name, [*LOAD, *entry_point_names()])
    return FUSED if path.suffix == FUSION_SUFFIX else _read_header(path).network, path


def _read_header(path: Path) -> Header:
    """Read the header of a checkpoint or an exported network."""
    if path.suffix == ONNX_SUFFIX:
        from lidar_perception.detectors.onnx_file import read_exported_header

        return read_exported_header(path)
    from lidar_perception.detectors.checkpoint import read_header

    return read_header(path)


def check_weights(path: Path, height: float) -> list[str]:
    """Return warnings about a file of weights, for a sensor `height` metres above the ground.

    The warnings concern a different sensor height in training, uncalibrated scores, and classes
    that are never detected. The sensor height of exported networks is not checked.
    """
    if path.suffix == FUSION_SUFFIX:
        from lidar_perception.detectors.fused.fusion import read_fusion

        fusion = read_fusion(path)
        return [
            *fusion.find_warnings(_read_header(fusion.proposer).config.classes),
            *check_weights(fusion.proposer, height),
            *check_weights(fusion.classifier, height),
        ]
    mismatch = _read_header(path).find_height_mismatch(height) if path.suffix == CHECKPOINT_SUFFIX else None
    return [f"{path}: {mismatch}"] if mismatch else []


@dataclass(frozen=True)
class DetectorChoice:
    """Arguments of open_detector, for opening the detector later, for example in a worker process."""

    weights: str = FUSED
    range: str = "auto"
    device: str = "auto"
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def later_imports(self) -> tuple[str, ...]:
        """Modules that open() imports, to be preloaded before forking because importing torch is slow."""
        loader = LOAD.get(resolve_weights(self.weights)[0])
        return () if loader is None else (_get_module_name(loader),)

    def open(self, *, sensor_height: float | None = None, min_score: float | None = None) -> ConfigurableDetector:
        """Open the detector, see open_detector."""
        return open_detector(
            self.weights,
            self.device,
            sensor_height=sensor_height,
            min_score=min_score,
            range=self.range,
            settings=self.settings,
        )
