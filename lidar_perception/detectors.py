"""Any detector of this package from its weights: frames in, detections out."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from lidar_perception.checkpoint import POINTNET, network_of
from lidar_perception.params import with_values
from lidar_perception.types import Detections, LidarFrame


class AnyDetector(Protocol):
    """detector(frame) -> Detections in the frame's own coordinates. After each call ms holds the
    time of each step, and problem why nothing, or little, can be found, or None."""

    ms: Mapping[str, float]
    problem: str | None

    def __call__(self, frame: LidarFrame) -> Detections: ...


def open_detector(path: str | Path, device: str = "auto",
                  sensor_height: float | None = None) -> AnyDetector:
    """The detector of a checkpoint of either network, or of an exported one (.onnx), with its
    default parameters; with sensor_height for a sensor so many metres above the ground. InputError
    for a file that cannot be used, or a device that is not there."""
    path = Path(path)
    if path.suffix != ".onnx" and network_of(path) == POINTNET:
        from lidar_perception.pointnet.detector import load_pointnet_detector
        detector = load_pointnet_detector(path, device)
    else:
        from lidar_perception.detection.detector import load_detector
        detector = load_detector(path, device)
    if sensor_height is not None:
        detector.params = with_values(detector.params,
                                      {"ground.sensor_pose.height": sensor_height})
    return detector
