"""Any detector of this package, by its name or from its weights."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, Self

from lidar_perception.detectors.checkpoint import POINTNET, POINTPILLARS, network_of
from lidar_perception.detectors.contract import FUSED, Detector
from lidar_perception.detectors.fused.detector import load_fused_detector
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
    checkpoint of any network, or an exported one (.onnx). Parameters are the defaults.

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
        detector = LOAD[POINTPILLARS if path.suffix == ".onnx" else network_of(path)](path, device)
    if where != "auto":
        detector = detector.seeing(where)
    if sensor_height is not None:
        detector = detector.mounted_at(sensor_height)
    return detector if min_score is None else detector.with_min_score(min_score)
