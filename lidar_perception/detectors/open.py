"""Any detector of this package, by its name or from its weights. Importing this module loads no
network: torch is loaded when a detector is opened."""

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
from lidar_perception.types import InputError, unknown_name

if TYPE_CHECKING:
    from lidar_perception.detectors.checkpoint import Header

POINTPILLARS, POINTNET = "pointpillars", "pointnet"

# Function load(path, device) of each detector, in this folder. An empty path means the weights of
# the package. A new detector is one line here; one with an entry in PARAMS, the parameters of its
# node, gets them as a third argument.
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
OTHER_FILES = {".onnx": POINTPILLARS, ".json": FUSED}  # files that are no checkpoints


class Configured(Detector, Protocol):
    """A detector with a dataclass of parameters, those of its node."""

    params: Any

    def with_params(self, params: Any) -> Self:
        """Return this detector with other parameters; this one does not change."""

    def with_range(self, range: str) -> Self:
        """Return this detector with another range, see base.NetworkDetector."""


@report_compilation(whole_detector=True)
def open_detector(weights: str | Path = FUSED, device: str = "auto", *,
                  sensor_height: float | None = None, min_score: float | None = None,
                  range: str = "auto", settings: Mapping[str, Any] = {}) -> Configured:
    """Open a detector by its name or from a file of weights.

    The first call on a machine compiles for a minute or two and reports it on standard error.

    Args:
        weights: name of a detector (fused, pointpillars or pointnet), with the weights that come
            with the package; or a file: a checkpoint (.safetensors), an exported network (.onnx)
            or what `train fused` wrote (.json).
        device: auto, cpu, cuda or cuda:N.
        sensor_height: height of the sensor above the ground in metres; None: that of KITTI.
        min_score: threshold of every class, 0..1; None: the defaults.
        range: ahead, around, or auto, the range that the weights were trained for.
        settings: other parameters by their dotted names, such as {"fused.scores.car": 0.7}. They
            take precedence over the arguments above.

    Raises:
        InputError: the file cannot be used, the detector cannot see that range, the device is not
            there, or a parameter is unknown or out of range.
    """
    if range not in RANGE_CHOICES:
        raise unknown_name("range", range, RANGE_CHOICES)
    kind, path = kind_and_file(weights)
    reference = None if kind in LOAD else find_reference(kind)
    asked = {} if device == "auto" else {f"{kind}.device": device}
    if range != "auto" and kind != POINTNET:
        asked[f"{kind}.range"] = range
    if path is not None and f"{kind}.weights" in settings:
        raise InputError(f"{kind}.weights is set, and {path} is given too; give one of them")
    try:
        if reference is not None:
            custom = CustomDetectorParams() if sensor_height is None else set_sensor_height(
                CustomDetectorParams(), sensor_height)
            detector: Any = load_custom_detector(reference, device, range, custom)
        elif kind in PARAMS:
            own = settings.get("pointnet.weights") if kind == POINTNET else None
            params = with_values(default_params(own or weights), {**asked, **settings})
            detector = _loader(kind)(path or "", getattr(params, kind).device, params)
        else:
            detector = _loader(kind)(path or "", device)
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
        weights: name of a detector, or file of its weights. PointNet finds ground and clusters as
            its weights were trained with.

    Raises:
        InputError: there is no such detector or file.
    """
    kind, path = kind_and_file(weights)
    if kind not in LOAD:
        return CustomDetectorParams()
    if kind not in PARAMS:
        return open_detector(weights).params
    params = _attribute(PARAMS[kind])()
    return _as_trained(params, path) if kind == POINTNET else params


def _loader(kind: str) -> Callable[..., Configured]:
    return _attribute(LOAD[kind])


def _attribute(path: str) -> Any:
    """Return the attribute `module.name` of a module in this folder."""
    module, _, name = path.rpartition(".")
    return getattr(importlib.import_module(f"lidar_perception.detectors.{module}"), name)


def _as_trained(params: Any, path: Path | None) -> Any:
    from lidar_perception.detectors.checkpoint import read_header
    from lidar_perception.detectors.pointnet.config import PointNetConfig
    from lidar_perception.detectors.pointnet.weights_file import weights_file
    try:
        config = read_header(path or weights_file(params.pointnet), PointNetConfig).config
    except InputError:
        if path is not None:
            raise
        return params  # without weights there is nothing to open, which is said then
    return replace(params, ground=config.ground, clustering=config.clustering)


def kind_and_file(weights: str | Path) -> tuple[str, Path | None]:
    """Return the name of a detector, and the file of its weights, None for those of the package and
    for classes.

    Raises:
        InputError: `weights` is neither the name of a detector, a class, nor a file of weights.
    """
    name, path = str(weights), Path(weights)
    if name in LOAD or (not path.exists() and find_reference(name)):
        return name, None
    if path.name == name and not path.suffix and not path.exists():
        raise unknown_name("detector or file of weights", name, [*LOAD, *entry_point_names()])
    return kind_of(path), path


def kind_of(path: Path) -> str:
    """The key in LOAD of a file of weights. InputError if it is none."""
    if path.suffix in OTHER_FILES:
        return OTHER_FILES[path.suffix]
    from lidar_perception.detectors.checkpoint import network_of
    return network_of(path)


def doubts(path: Path, height: float) -> list[str]:
    """What to say of weights that are used with a sensor so many metres above the ground: that they
    are for one at another height, that their scores are no probabilities, or that some of their
    classes are never detected. Of an exported network nothing is known."""
    if OTHER_FILES.get(path.suffix) == FUSED:
        from lidar_perception.detectors.fused.fusion import read_fusion
        fusion = read_fusion(path)
        known = _header(fusion.proposer)
        return [*fusion.doubts(known.config.classes if known else ()),
                *doubts(fusion.proposer, height), *doubts(fusion.classifier, height)]
    known = _header(path)
    other = known.unlike(height) if known else None
    return [f"{path}: {other}"] if other else []


def _header(path: Path) -> Header | None:
    if path.suffix != ".safetensors":
        return None
    from lidar_perception.detectors.checkpoint import read_header
    return read_header(path)


@dataclass(frozen=True)
class DetectorChoice:
    """A detector that is not opened yet: what open_detector takes."""

    weights: str = FUSED
    range: str = "auto"
    device: str = "auto"
    settings: Mapping[str, Any] = field(default_factory=dict)

    def open(self, *, sensor_height: float | None = None,
             min_score: float | None = None) -> Configured:
        """Open the detector, see open_detector."""
        return open_detector(self.weights, self.device, sensor_height=sensor_height,
                             min_score=min_score, range=self.range, settings=self.settings)
