"""Open a detector by its name or from a file of weights. Importing this module does not import
torch; opening a detector does."""

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

# Each detector's function load(path, device) in this folder. An empty path means the shipped
# weights. A new detector is one line here. If it has an entry in PARAMS, the parameters of its
# node, its function gets them as a third argument.
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
ONNX = ".onnx"
DETECTOR_BY_SUFFIX = {ONNX: POINTPILLARS, ".json": FUSED}  # suffixes of files other than checkpoints


class ConfigurableDetector(Detector, Protocol):
    """A detector whose `params` are the parameters of its node, a dataclass."""

    params: Any

    def with_params(self, params: Any) -> Self:
        """Return a copy of this detector with other parameters."""

    def with_range(self, range: str) -> Self:
        """Return a copy of this detector with another range, see base.NetworkDetector."""


@report_compilation(whole_detector=True)
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

    The first call on a machine compiles Numba functions for a minute or two and reports this on
    standard error.

    Args:
        weights: name of a detector (fused, pointpillars or pointnet) with its shipped weights; or
            a file: a checkpoint (.safetensors), an exported network (.onnx) or the output of
            `train fused` (.json).
        device: auto, cpu, cuda or cuda:N.
        sensor_height: height of the sensor above the ground in metres; None: 1.73 m, as in KITTI.
        min_score: threshold of every class, 0..1; None: the defaults.
        range: ahead, around, or auto (the range of the training).
        settings: other parameters by their dotted names, such as {"fused.scores.car": 0.7}. They
            take precedence over the arguments above.

    Raises:
        InputError: the file cannot be used, the detector cannot cover that range, the device does
            not exist, or a parameter is unknown or out of range.
    """
    if range not in RANGE_CHOICES:
        raise make_unknown_name_error("range", range, RANGE_CHOICES)
    kind, path = resolve_weights(weights)
    reference = None if kind in LOAD else find_reference(kind)
    arguments = {} if device == "auto" else {f"{kind}.device": device}
    if range != "auto" and kind != POINTNET:
        arguments[f"{kind}.range"] = range
    if path is not None and f"{kind}.weights" in settings:
        raise InputError(f"both {kind}.weights and {path} are given; give one of them")
    try:
        if reference is not None:
            custom = (
                CustomDetectorParams()
                if sensor_height is None
                else set_sensor_height(CustomDetectorParams(), sensor_height)
            )
            detector: Any = load_custom_detector(reference, device, range, custom)
        elif kind in PARAMS:
            weights_param = settings.get("pointnet.weights") if kind == POINTNET else None
            params = with_values(default_params(weights_param or weights), {**arguments, **settings})
            detector = _find_loader(kind)(path or "", getattr(params, kind).device, params)
        else:
            detector = _find_loader(kind)(path or "", device)
        if reference is None and range != "auto" and f"{kind}.range" not in settings:
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


def default_params(weights: str | Path) -> Any:
    """Return the default parameters of a detector, a dataclass of groups.

    Args:
        weights: name of a detector, or file of its weights. PointNet gets the ground and clustering
            parameters of its training.

    Raises:
        InputError: there is no such detector or file.
    """
    kind, path = resolve_weights(weights)
    if kind not in LOAD:
        return CustomDetectorParams()
    if kind not in PARAMS:
        return open_detector(weights).params
    params = _import_attribute(PARAMS[kind])()
    return _apply_training_params(params, path) if kind == POINTNET else params


def _find_loader(kind: str) -> Callable[..., ConfigurableDetector]:
    return _import_attribute(LOAD[kind])


def _import_attribute(path: str) -> Any:
    """Return the attribute `module.name` of a module in this folder."""
    return getattr(importlib.import_module(_get_module_name(path)), path.rpartition(".")[2])


def _get_module_name(path: str) -> str:
    return f"lidar_perception.detectors.{path.rpartition('.')[0]}"


def _apply_training_params(params: Any, path: Path | None) -> Any:
    from lidar_perception.detectors.checkpoint import read_header
    from lidar_perception.detectors.pointnet.config import PointNetConfig
    from lidar_perception.detectors.weights_file import find_pointnet_weights

    try:
        if path is not None and path.suffix == ONNX:
            from lidar_perception.detectors.onnx_file import read_exported_header

            config = read_exported_header(path).config
        else:
            config = read_header(path or find_pointnet_weights(params.pointnet), PointNetConfig).config
    except InputError:
        if path is not None:
            raise
        return params  # open_detector reports the missing weights
    return replace(params, ground=config.ground, clustering=config.clustering)


def resolve_weights(weights: str | Path) -> tuple[str, Path | None]:
    """Resolve a detector name, custom class or file to a detector name and the file of its weights.

    The file is None for shipped weights and for custom detectors.

    Raises:
        InputError: `weights` is not a detector, a class or a file of weights.
    """
    name, path = str(weights), Path(weights)
    if name in LOAD or (not path.exists() and find_reference(name)):
        return name, None
    if path.name == name and not path.suffix and not path.exists():
        raise make_unknown_name_error("detector or file of weights", name, [*LOAD, *entry_point_names()])
    return find_kind(path), path


def find_kind(path: Path) -> str:
    """Return the key in LOAD for a file of weights. InputError if the file is not valid."""
    if path.suffix == ONNX and path.is_file():
        from lidar_perception.detectors.onnx_file import read_exported_name

        return read_exported_name(path)
    if path.suffix in DETECTOR_BY_SUFFIX:
        return DETECTOR_BY_SUFFIX[path.suffix]
    from lidar_perception.detectors.checkpoint import read_network_name

    return read_network_name(path)


def check_weights(path: Path, height: float) -> list[str]:
    """Return warnings about a file of weights, for a sensor `height` metres above the ground.

    The warnings are about another sensor height in training, uncalibrated scores, and classes that
    are never detected. Exported networks are not checked.
    """
    if DETECTOR_BY_SUFFIX.get(path.suffix) == FUSED:
        from lidar_perception.detectors.fused.fusion import read_fusion

        fusion = read_fusion(path)
        header = _read_header(fusion.proposer)
        return [
            *fusion.find_warnings(header.config.classes if header else ()),
            *check_weights(fusion.proposer, height),
            *check_weights(fusion.classifier, height),
        ]
    header = _read_header(path)
    mismatch = header.find_height_mismatch(height) if header else None
    return [f"{path}: {mismatch}"] if mismatch else []


def _read_header(path: Path) -> Header | None:
    if path.suffix != ".safetensors":
        return None
    from lidar_perception.detectors.checkpoint import read_header

    return read_header(path)


@dataclass(frozen=True)
class DetectorChoice:
    """Arguments of open_detector for a detector to open later, such as in a worker process."""

    weights: str = FUSED
    range: str = "auto"
    device: str = "auto"
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def later_imports(self) -> tuple[str, ...]:
        """Modules that open() imports; preload them before forking, since importing torch is slow."""
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
