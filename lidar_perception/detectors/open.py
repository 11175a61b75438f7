"""Any detector of this package from its weights: frames in, detections out."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from lidar_perception.detectors.checkpoint import POINTNET, network_of
from lidar_perception.param_fields import parameter_fields, with_values
from lidar_perception.types import Detections, LidarFrame


class AnyDetector(Protocol):
    """detector(frame) -> Detections in the frame's own coordinates. After each call ms holds the
    time of each step, and problem why nothing, or little, can be found, or None."""

    ms: Mapping[str, float]
    problem: str | None

    def __call__(self, frame: LidarFrame) -> Detections: ...


def open_detector(path: str | Path, device: str = "auto",
                  sensor_height: float | None = None,
                  least_score: float | None = None) -> AnyDetector:
    """The detector of a checkpoint of either network, or of an exported one (.onnx), with its
    default parameters; with sensor_height for a sensor so many metres above the ground, with
    least_score that threshold for every class. InputError for a file that cannot be used, or a
    device that is not there."""
    path = Path(path)
    if path.suffix != ".onnx" and network_of(path) == POINTNET:
        from lidar_perception.detectors.pointnet.detector import load_pointnet_detector
        detector = load_pointnet_detector(path, device)
    else:
        from lidar_perception.detectors.pointpillars.detector import load_detector
        detector = load_detector(path, device)
    changed: dict[str, float] = {}
    if sensor_height is not None:
        changed["ground.sensor_pose.height"] = sensor_height
    if least_score is not None:
        changed |= dict.fromkeys((field for field in parameter_fields(detector.params)
                                  if ".scores." in field), least_score)
    detector.params = with_values(detector.params, changed)
    return detector
