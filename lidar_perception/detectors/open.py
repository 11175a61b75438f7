"""Any detector of this package, by its name or from its weights."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, Self

from lidar_perception.detectors.checkpoint import (
    POINTNET,
    POINTPILLARS,
    Header,
    network_of,
    read_header,
)
from lidar_perception.detectors.contract import FUSED, Detector
from lidar_perception.detectors.fused.detector import load_fused_detector
from lidar_perception.detectors.fused.fusion import SUFFIX, read_fusion
from lidar_perception.detectors.params import SEEN
from lidar_perception.detectors.pointnet.detector import load_pointnet_detector
from lidar_perception.detectors.pointpillars.detector import load_detector
from lidar_perception.types import InputError


class Configured(Detector, Protocol):
    """A detector with a dataclass of parameters, those of its node."""

    params: Any

    def seeing(self, where: str) -> Self:
        """The same detector that sees ahead or around, see base.NetworkDetector."""


# Each opens its detector: load(path, device), where an empty path means its own weights, if it has
# any. A new detector is one line here.
LOAD: dict[str, Callable[..., Configured]] = {
    POINTPILLARS: load_detector,
    POINTNET: load_pointnet_detector,
    FUSED: load_fused_detector,
}


def open_detector(weights: str | Path = FUSED, device: str = "auto", *,
                  sensor_height: float | None = None, min_score: float | None = None,
                  where: str = "auto") -> Configured:
    """A detector by its name, a key of LOAD, with what comes with the package; or by its weights: a
    checkpoint of any network, an exported one (.onnx), or a file of `train fused` (.json).
    Parameters are the defaults.

    sensor_height: metres of the sensor above the ground, if not KITTI's; min_score: the threshold
    of every class, if not the default; where: what it sees, ahead, around, or what the weights were
    trained for (auto). InputError for a file that cannot be used or cannot see that, or a device
    that is not there.
    """
    if where not in SEEN:
        raise InputError(f"where = {where!r} must be one of {', '.join(SEEN)}")
    if str(weights) in LOAD:
        detector = LOAD[str(weights)]("", device)
    else:
        path = Path(weights)
        detector = LOAD[kind_of(path)](path, device)
    if where != "auto":
        detector = detector.seeing(where)
    if sensor_height is not None:
        detector = detector.mounted_at(sensor_height)
    return detector if min_score is None else detector.with_min_score(min_score)


def kind_of(path: Path) -> str:
    """The key in LOAD of a file of weights. InputError if it is none."""
    return {".onnx": POINTPILLARS, SUFFIX: FUSED}.get(path.suffix) or network_of(path)


def doubts(path: Path, height: float) -> list[str]:
    """What to say of weights that are used with a sensor so many metres above the ground: that they
    are for one at another height, that their scores are no probabilities, or that some of their
    classes are never detected. Of an exported network nothing is known."""
    if path.suffix == SUFFIX:
        fusion = read_fusion(path)
        known = _header(fusion.proposer)
        return [*fusion.doubts(known.config.classes if known else ()),
                *doubts(fusion.proposer, height), *doubts(fusion.classifier, height)]
    known = _header(path)
    other = known.unlike(height) if known else None
    return [f"{path}: {other}"] if other else []


def _header(path: Path) -> Header | None:
    return read_header(path) if path.suffix == ".safetensors" else None
