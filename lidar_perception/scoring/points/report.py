"""Ground segmentation and clustering against labelled points or boxes, frame by frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any

import numpy as np

from lidar_perception.candidates.segmented_cloud import crop_to_view
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.clustering.params import ClusteringParams
from lidar_perception.data.frame import Frame, PointTruth, Recording
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
    """Parameters; the camera's view is on because KITTI labels nothing outside it."""

    view: ViewParams = ViewParams(enabled=True)
    ground: GroundParams = GroundParams()
    clustering: ClusteringParams = ClusteringParams()


@dataclass(frozen=True)
class SegmentationResult:
    """Arguments of GroundReport.update and ClusterReport.update by method, for one frame.

    whole is True if there was no camera to crop to.
    """

    ground: dict[str, tuple] = field(default_factory=dict)
    clusters: dict[str, tuple] = field(default_factory=dict)
    whole: bool = False


def measure_methods(
    params: SegmentationParams, grounds: tuple[str, ...], clusterings: tuple[str, ...], recording: Recording
) -> Callable[[Frame], SegmentationResult | None]:
    """Run ground and clustering methods on every labelled frame.

    Ground is scored on labelled points. Clusters are scored on labelled instances or boxes; with
    boxes on the ground of params, in the camera's view if there is a camera.
    partial(measure_methods, params, grounds, clusterings) is a Start of scoring.run.
    """
    timer = Timer()

    def measure_points(frame: Frame, labels: Any) -> SegmentationResult:
        scan, found, ground = frame.load(), {}, {}
        z = scan.xyz[:, 2] + np.float32(frame.sensor_height - SENSOR_HEIGHT)
        for name in grounds:
            found[name], ms = timer(segment_ground, scan, replace(params.ground, method=name))
            ground[name] = count_by_protocol(found[name], labels.classes, z), ms
        if not clusterings:
            return SegmentationResult(ground)
        chosen = found.get(params.ground.method)
        if chosen is None:
            chosen = segment_ground(scan, params.ground)
        objects = find_instances(scan.xyz, labels.classes, labels.instances)
        return SegmentationResult(ground, score_methods(scan, chosen, objects))

    def measure_boxes(frame: Frame, truth: Any) -> SegmentationResult:
        scan, camera = frame.load(), frame.camera()
        if camera is not None:
            _, scan = crop_to_view(scan, camera, params.view)
        return SegmentationResult(
            {},
            score_methods(scan, segment_ground(scan, params.ground), find_objects_in_boxes(scan.xyz, truth)),
            whole=camera is None and params.view.enabled,
        )

    def score_methods(scan: PointCloud, ground: np.ndarray, objects: Objects) -> dict:
        scores = {}
        for name in clusterings:
            ids, ms = timer(cluster_obstacles, scan.xyz, ground, replace(params.clustering, method=name))
            scores[name] = objects.classes, objects.ranges, score_clusters(ids, objects), ms
        return scores

    def measure(frame: Frame) -> SegmentationResult | None:
        labels = frame.point_truth()
        if labels is not None:
            return measure_points(frame, labels)
        truth = frame.truth()
        return None if truth is None or not clusterings else measure_boxes(frame, truth)

    return measure


class Timer:
    """Stopwatch: timer(function, *arguments) -> (result, milliseconds).

    The first call of a method is preceded by a run that loads compiled code.
    """

    def __init__(self) -> None:
        self.warm: set[tuple[Any, str]] = set()

    def __call__(self, function: Callable, *arguments: Any) -> tuple[Any, float]:
        key = function, arguments[-1].method
        if key not in self.warm:
            function(*arguments)
            self.warm.add(key)
        start = perf_counter()
        result = function(*arguments)
        return result, (perf_counter() - start) * 1e3


@dataclass
class SegmentationReport:
    """Scores of ground by method, and of clusters by source and method.

    source is the format of the next recording; whole counts frames without a camera to crop to.
    """

    source: str = ""
    ground: dict[str, GroundReport] = field(default_factory=dict)
    clusters: dict[str, dict[str, ClusterReport]] = field(default_factory=dict)
    skipped: list[str] = field(default_factory=list)
    whole: int = 0

    def update(self, result: SegmentationResult) -> None:
        """Add one frame."""
        for name, counts in result.ground.items():
            self.ground.setdefault(name, GroundReport()).update(*counts)
        for name, scores in result.clusters.items():
            self.clusters.setdefault(self.source, {}).setdefault(name, ClusterReport()).update(*scores)
        self.whole += result.whole

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


def segment_by_methods(
    frame: Frame, params: SegmentationParams, grounds: tuple[str, ...]
) -> tuple[PointCloud, PointTruth | None, dict[str, np.ndarray]]:
    """Return a frame, its labels, and the ground (N,) bool by each method, for a picture."""
    scan = frame.load()
    return (
        scan,
        frame.point_truth(),
        {name: segment_ground(scan, replace(params.ground, method=name)) for name in grounds},
    )
