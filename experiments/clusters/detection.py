"""Detections of all networks in one frame (paper C, Section 3.2)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from time import perf_counter
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np

from experiments.clusters.networks import DetectorSource, get_compared_sources, get_sources
from experiments.framework.precision import to_record
from experiments.framework.trained_models import TrainedModel
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.clustering.params import ClusteringParams
from lidar_perception.data.frame import Frame
from lidar_perception.detectors.base import NetworkDetector
from lidar_perception.detectors.open import POINTNET, open_detector, resolve_weights
from lidar_perception.detectors.params import MIN_SCORE
from lidar_perception.detectors.pointnet.detector import PointNetDetector
from lidar_perception.ground.params import GroundParams
from lidar_perception.ground.segment import segment_ground
from lidar_perception.scoring.detections import thin_scan
from lidar_perception.scoring.kitti.camera_objects import to_camera_objects, to_scored_labels
from lidar_perception.training.augment import blur_ranges
from lidar_perception.types import Detections, InputError, PointCloud


class Change(NamedTuple):
    """A change of a cloud.

    Attributes:
        fraction: Fraction of the points that are kept.
        noise: Standard deviation of noise along the beams, metres.
    """

    fraction: float = 1.0
    noise: float = 0.0


CHANGES = {  # changes of Table 8; the paper does not state the amount of noise
    "50 %": Change(0.5),
    "20 %": Change(0.2),
    "10 %": Change(0.1),
    "noise 2 cm": Change(noise=0.02),
    "noise 5 cm": Change(noise=0.05),
    "noise 10 cm": Change(noise=0.1),
}


def measure_detection(frame: Frame, models: Mapping[str, TrainedModel]) -> dict[str, Any]:
    """Detect the objects of a frame with every detector, and those of changed clouds with some.

    Returns:
        - truth: the labels, see framework.precision.to_record
        - found: name of a detector -> detections
        - changed: change -> name of a detector -> detections
        - detector_ms: name of a detector -> total time of ground, clusters and network
        - changed_ms: change -> name of a detector -> total time

    Raises:
        InputError: The frame has no labels.
    """
    truth, calibration = frame.truth(), frame.calibration()
    if truth is None:
        raise InputError(f"{frame.points or frame.name} has no labels; put the label files next to the scans")

    def detect(change: Change, sources: Mapping[str, DetectorSource]) -> tuple[dict[str, Any], dict[str, float]]:
        results = detect_with_all(change_cloud(frame.load(), change, frame.name), sources, frame.sensor_height)
        return (
            {
                name: to_record(to_camera_objects(to_scored_labels(boxes), calibration))
                for name, (boxes, _) in results.items()
            },
            {name: round(ms, 3) for name, (_, ms) in results.items()},
        )

    detections, times = detect(Change(), get_sources(models))
    changed_results = {name: detect(change, get_compared_sources(models)) for name, change in CHANGES.items()}
    return {
        "truth": to_record(to_camera_objects(truth, calibration)),
        "found": detections,
        "changed": {name: boxes for name, (boxes, _) in changed_results.items()},
        "detector_ms": times,
        "changed_ms": {name: ms for name, (_, ms) in changed_results.items()},
    }


def detect_with_all(
    cloud: PointCloud, sources: Mapping[str, DetectorSource], height: float, range: str = "auto"
) -> dict[str, tuple[Detections, float]]:
    """Run detectors on a cloud. Detectors with equal parameters share the ground and clusters.

    Args:
        cloud: The cloud.
        sources: The detectors by name.
        height: Height of the sensor, metres.
        range: Range of PointPillars, see open_detector. PointNet covers all directions.

    Returns:
        For each detector its detections, and the total time of ground, clusters and network in ms.
    """
    ground: dict[GroundParams, tuple[np.ndarray, float]] = {}
    clusters: dict[tuple[GroundParams, ClusteringParams], tuple[np.ndarray, float]] = {}
    results = {}
    for name, source in sources.items():
        detector = open_network(source, height, range)
        if not isinstance(detector, PointNetDetector):
            result = detector(cloud)
            results[name] = result.detections, sum(result.timings.values())
            continue
        params = detector.params
        if params.ground not in ground:
            ground[params.ground] = _time(segment_ground, cloud, params.ground)
        ground_mask, ground_ms = ground[params.ground]
        key = params.ground, params.clustering
        if key not in clusters:
            clusters[key] = _time(cluster_obstacles, cloud.xyz, ground_mask, params.clustering)
        cluster_ids, clusters_ms = clusters[key]
        result = detector(cloud, ground=ground_mask, cluster_ids=cluster_ids)
        results[name] = result.detections, ground_ms + clusters_ms + sum(result.timings.values())
    return results


@lru_cache(maxsize=64)
def open_network(source: DetectorSource, height: float, range: str = "auto") -> NetworkDetector:
    """Open a detector that also returns detections with low scores, which average precision needs."""
    kind, _ = resolve_weights(source.weights)
    settings: dict[str, Any] = {f"{kind}.warm_up": False}
    if source.gamma is not None:
        settings["clustering.euclidean.gamma"] = source.gamma
    detector = open_detector(
        source.weights,
        "cpu",
        sensor_height=height,
        min_score=MIN_SCORE,
        range="auto" if kind == POINTNET else range,
        settings=settings,
    )
    assert isinstance(detector, NetworkDetector)
    return detector


def change_cloud(cloud: PointCloud, change: Change, name: str) -> PointCloud:
    """Remove points from a cloud or add noise. The name of the frame is the random seed."""
    cloud = thin_scan(cloud, change.fraction, name)
    if change.noise == 0.0:
        return cloud
    rng = np.random.default_rng(crc32(name.encode()))
    points = blur_ranges(cloud.points(), 0.0, change.noise, rng)
    return replace(cloud, xyz=np.ascontiguousarray(points[:, :3]))


def _time(function: Callable[..., np.ndarray], *arguments: Any) -> tuple[np.ndarray, float]:
    start = perf_counter()
    result = function(*arguments)
    return result, (perf_counter() - start) * 1e3
