"""Scores of ground segmentation and clustering on labelled points or boxes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any

import numpy as np

from lidar_perception.candidates.segmented_cloud import crop_to_view
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.clustering.params import ClusteringParams
from lidar_perception.data.frame import Frame, Recording
from lidar_perception.ground.params import GroundParams
from lidar_perception.ground.segment import segment_ground
from lidar_perception.scoring.points.segmentation import (
    ClusterReport,
    GroundReport,
    Objects,
    count_by_protocol,
    find_instances,
    find_objects_in_boxes,
    score_clusters,
)
from lidar_perception.types import SENSOR_HEIGHT, PointCloud
from lidar_perception.wire.params import ViewParams


@dataclass(frozen=True)
class SegmentationParams:
    """Parameters of ground segmentation and clustering.

    The crop to the camera's view is on by default because KITTI has no labels outside it.
    """

    view: ViewParams = ViewParams(enabled=True)
    ground: GroundParams = GroundParams()
    clustering: ClusteringParams = ClusteringParams()


@dataclass(frozen=True)
class SegmentationResult:
    """Results of all methods for one frame.

    Attributes:
        ground: Arguments of GroundReport.update by method.
        clusters: Arguments of ClusterReport.update by method.
        without_camera: True if the frame has no camera calibration and was scored in all directions.
    """

    ground: dict[str, tuple] = field(default_factory=dict)
    clusters: dict[str, tuple] = field(default_factory=dict)
    without_camera: bool = False


def measure_methods(
    params: SegmentationParams,
    ground_methods: tuple[str, ...],
    clustering_methods: tuple[str, ...],
    recording: Recording,
) -> Callable[[Frame], SegmentationResult | None]:
    """Make a function that runs ground and clustering methods on every labelled frame.

    Ground is scored on labelled points, clusters on labelled instances or boxes. Frames with boxes
    are cropped to the camera's view if they have a calibration.
    partial(measure_methods, params, ground_methods, clustering_methods) is a StartMeasurement of
    scoring.run.
    """
    timer = Timer()

    def measure_points(frame: Frame, labels: Any) -> SegmentationResult:
        scan, ground_by_method, ground = frame.load(), {}, {}
        z = scan.xyz[:, 2] + np.float32(frame.sensor_height - SENSOR_HEIGHT)
        for name in ground_methods:
            ground_by_method[name], ms = timer(segment_ground, scan, replace(params.ground, method=name))
            ground[name] = count_by_protocol(ground_by_method[name], labels.classes, z), ms
        if not clustering_methods:
            return SegmentationResult(ground)
        obstacle_ground = ground_by_method.get(params.ground.method)
        if obstacle_ground is None:
            obstacle_ground = segment_ground(scan, params.ground)
        objects = find_instances(scan.xyz, labels.classes, labels.instances)
        return SegmentationResult(ground, score_methods(scan, obstacle_ground, objects))

    def measure_boxes(frame: Frame, truth: Any) -> SegmentationResult:
        scan, camera = frame.load(), frame.camera()
        if camera is not None:
            _, scan = crop_to_view(scan, camera, params.view)
        return SegmentationResult(
            {},
            score_methods(scan, segment_ground(scan, params.ground), find_objects_in_boxes(scan.xyz, truth)),
            without_camera=camera is None and params.view.enabled,
        )

    def score_methods(scan: PointCloud, ground: np.ndarray, objects: Objects) -> dict:
        scores = {}
        for name in clustering_methods:
            ids, ms = timer(cluster_obstacles, scan.xyz, ground, replace(params.clustering, method=name))
            scores[name] = objects.classes, objects.ranges, score_clusters(ids, objects), ms
        return scores

    def measure(frame: Frame) -> SegmentationResult | None:
        labels = frame.point_truth()
        if labels is not None:
            return measure_points(frame, labels)
        truth = frame.truth()
        return None if truth is None or not clustering_methods else measure_boxes(frame, truth)

    return measure


class Timer:
    """Stopwatch: timer(function, *arguments) returns (result, milliseconds).

    Each method runs once before its first measurement, to load compiled code.
    """

    def __init__(self) -> None:
        self.warmed_up: set[tuple[Any, str]] = set()

    def __call__(self, function: Callable, *arguments: Any) -> tuple[Any, float]:
        key = function, arguments[-1].method
        if key not in self.warmed_up:
            function(*arguments)
            self.warmed_up.add(key)
        start = perf_counter()
        result = function(*arguments)
        return result, (perf_counter() - start) * 1e3


@dataclass
class SegmentationReport:
    """Ground scores by method, and cluster scores by recording format and method.

    Attributes:
        source: Format of the recording that is being measured.
        ground: Ground scores by method.
        clusters: Cluster scores by format and method.
        skipped: Reasons for skipped frames.
        without_camera: Number of frames without a camera calibration.
    """

    source: str = ""
    ground: dict[str, GroundReport] = field(default_factory=dict)
    clusters: dict[str, dict[str, ClusterReport]] = field(default_factory=dict)
    skipped: list[str] = field(default_factory=list)
    without_camera: int = 0

    def update(self, result: SegmentationResult) -> None:
        """Add one frame."""
        for name, counts in result.ground.items():
            self.ground.setdefault(name, GroundReport()).update(*counts)
        for name, scores in result.clusters.items():
            self.clusters.setdefault(self.source, {}).setdefault(name, ClusterReport()).update(*scores)
        self.without_camera += result.without_camera

    def compute(self) -> dict[str, Any]:
        """Return the content of the JSON file."""
        return {
            "ground": {name: report.compute() for name, report in self.ground.items()},
            "clusters": {
                source: {name: report.compute() for name, report in reports.items()}
                for source, reports in self.clusters.items()
            },
            "skipped": self.skipped,
        }
