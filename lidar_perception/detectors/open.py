"""Any detector of this package from its weights."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from lidar_perception.detectors.base import NetworkDetector
from lidar_perception.detectors.checkpoint import POINTNET, POINTPILLARS, network_of
from lidar_perception.detectors.pointnet.detector import load_pointnet_detector
from lidar_perception.detectors.pointpillars.detector import load_detector
from lidar_perception.param_fields import with_values

LOAD: dict[str, Callable[..., NetworkDetector]] = {  # by network
    POINTPILLARS: load_detector,
    POINTNET: load_pointnet_detector,
}


def open_detector(path: str | Path = "", device: str = "auto", *,
                  sensor_height: float | None = None,
                  min_score: float | None = None) -> NetworkDetector:
    """The detector of a checkpoint of any network, or of an exported one (.onnx), with its default
    parameters; without a path PointPillars v4 compact, which comes with the package.

    sensor_height: metres of the sensor above the ground, if not KITTI's; min_score: the threshold
    of every class, if not the default. InputError for a file that cannot be used, or a device that
    is not there.
    """
    path = Path(path)
    exported = path.suffix == ".onnx" or path == Path()
    detector = LOAD[POINTPILLARS if exported else network_of(path)](path, device)
    if sensor_height is not None:
        detector.params = with_values(detector.params,
                                      {"ground.sensor_pose.height": sensor_height})
    return detector if min_score is None else detector.with_min_score(min_score)
