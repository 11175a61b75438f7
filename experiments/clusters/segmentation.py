"""Measurement of the segmentation of one frame, without networks (paper C, Section 3.1)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np

from experiments.clusters.range_image import cluster_range_image
from lidar_perception.clustering.cluster import cluster
from lidar_perception.clustering.params import ClusteringParams, EuclideanParams
from lidar_perception.data.frame import Frame
from lidar_perception.ground.params import GroundParams
from lidar_perception.ground.segment import segment_ground
from lidar_perception.param_fields import with_values
from lidar_perception.scoring.points.clusters import find_unlabelled
from lidar_perception.scoring.points.segmentation import Objects, find_objects_in_boxes, score_clusters
from lidar_perception.types import InputError, PointCloud

PAPER = EuclideanParams()  # alpha 1.2, beta 0.5, gamma 0.8; threshold of Eq. 11


@dataclass(frozen=True)
class SegmentationStudy:
    """Parameters that Table 2 varies one at a time. The paper gives only the best values.

    Attributes:
        curvature: Limit of curvature-consistent growing, see clustering/curvature.py.
        distance: Threshold of plain Euclidean clustering, metres.
    """

    alpha: tuple[float, ...] = (0.8, 1.0, 1.2, 1.4, 1.6)
    beta: tuple[float, ...] = (0.3, 0.4, 0.5, 0.6, 0.7)
    gamma: tuple[float, ...] = (0.0, 0.4, 0.6, 0.8, 1.0)
    curvature: float = 0.03
    distance: float = 0.5


STUDY = SegmentationStudy()


def _make_euclidean(**changes: Any) -> Callable[[np.ndarray], np.ndarray]:
    params = ClusteringParams(method="euclidean", euclidean=with_values(PAPER, changes))
    return partial(cluster, params=params)


# Name -> function that clusters points (N, 3) without ground. Differences are relative to the first method.
METHODS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "Euclidean, fixed": _make_euclidean(threshold="fixed", distance=STUDY.distance, beta=0.0, gamma=0.0),
    "DBSCAN": partial(cluster, params=ClusteringParams(method="dbscan")),
    "range image": cluster_range_image,
    "ours": _make_euclidean(),
    "ours, Eq. 6": _make_euclidean(threshold="global"),
    "ours, gamma 0": _make_euclidean(gamma=0.0),
    "ours, gamma 0, curvature": _make_euclidean(gamma=0.0, curvature=STUDY.curvature),
}
SWEEPS: dict[str, dict[str, Callable[[np.ndarray], np.ndarray]]] = {
    name: {f"{value:g}": _make_euclidean(**{name: value}) for value in getattr(STUDY, name)}
    for name in ("alpha", "beta", "gamma")
}
# Names of the columns that count_points() returns.
COUNT_COLUMNS = (
    "points",
    "right",
    "right object points",
    "found object points",
    "object points",
    "objects",
    "hits",
    "judged",
    "iou",
)


def measure_segmentation(frame: Frame) -> dict[str, Any]:
    """Cluster the points of a frame with every method, and compare the clusters with the labelled boxes.

    All methods cluster the whole cloud without the ground that the cloth method finds. Only points
    in the camera's view are compared, if there is a camera, and no points in regions without
    labels.

    Returns:
        `methods` and `sweeps`: name -> result of count_points(). `ms`: the same names and `ground`
        -> duration.

    Raises:
        InputError: The frame has no labels, or none of its objects has enough points.
    """
    truth = frame.truth()
    if truth is None:
        raise InputError(f"{frame.points or frame.name} has no labels; put the label files next to the scans")
    scan, camera = frame.load(), frame.camera()
    objects = find_objects_in_boxes(scan.xyz, truth)
    if camera is not None:
        is_compared = camera.in_view(scan.xyz)
        is_compared[is_compared] = ~find_unlabelled(truth, camera, scan.xyz[is_compared])
        objects = limit_to_points(objects, is_compared)
    if not objects.owner.any():
        raise InputError("no labelled object has enough points")
    ground, ms = _time("ground", partial(_segment, frame.sensor_height), scan)
    times = {"ground": ms}
    methods, sweeps = {}, {}
    for name, function in METHODS.items():
        methods[name], times[name] = _measure(name, function, scan, ground, objects)
    for name, functions in SWEEPS.items():
        for value, function in functions.items():
            key = f"{name} {value}"
            sweeps[key], times[key] = _measure("ours", function, scan, ground, objects)
    return {"methods": methods, "sweeps": sweeps, "ms": times}


def limit_to_points(objects: Objects, mask: np.ndarray) -> Objects:
    """Limit the comparison with objects to the points of a mask (N,)."""
    return Objects(
        np.where(mask, objects.owner, 0),
        np.where(mask, objects.region, 0),
        objects.is_near & mask,
        objects.is_counted & mask,
        objects.classes,
        objects.ranges,
    )


def count_points(cluster_ids: np.ndarray, ground: np.ndarray, objects: Objects) -> list[float]:
    """Compare the clusters of a frame with its objects, point by point.

    Every object is paired with at most one cluster; pairs with the largest IoU come first. A point
    is found for the object whose cluster contains it. It is right if it belongs to that object, or
    if it belongs to no object and is in no paired cluster. Ground outside objects and the neutral
    points at the bottom of boxes are ignored, because the many points on the road would dominate.

    Args:
        cluster_ids: (N,) clusters.
        ground: (N,) bool.
        objects: Objects of the frame.

    Returns:
        Values of COUNT_COLUMNS: numbers of compared points, of right points, of right points on
        objects, of points found for an object, of points on objects, of objects, of hits (IoU above
        0.5), and of clusters that score_clusters() scores; and the sum of the objects' IoU.
    """
    is_compared = objects.is_counted & ((objects.owner > 0) | ~ground)
    is_compared &= (objects.owner > 0) == (objects.region > 0)
    ids, owner = (a.compress(is_compared).astype(np.int64) for a in (cluster_ids, objects.owner))
    cluster_by_object = pair_clusters(ids, owner, len(objects.classes))
    object_by_cluster = np.zeros(int(ids.max(initial=0)) + 1, np.int64)
    object_by_cluster[cluster_by_object[cluster_by_object > 0]] = np.flatnonzero(cluster_by_object > 0) + 1
    found_object = object_by_cluster[ids]
    score = score_clusters(cluster_ids, objects)
    has_points = np.bincount(owner, minlength=len(objects.classes) + 1)[1:] > 0
    is_right = found_object == owner
    return [
        len(ids),
        int(is_right.sum()),
        int((is_right & (owner > 0)).sum()),
        int((found_object > 0).sum()),
        int((owner > 0).sum()),
        int(has_points.sum()),
        int((score.iou[has_points] > 0.5).sum()),
        score.scored_count,
        round(float(score.iou[has_points].sum()), 6),
    ]


def pair_clusters(ids: np.ndarray, owner: np.ndarray, count: int) -> np.ndarray:
    """Pair objects with clusters by their common points, largest IoU first.

    Args:
        ids: (P,) cluster of each point, 0 for none.
        owner: (P,) object of each point, from 1; 0 for none.
        count: Number of objects.

    Returns:
        (count,) cluster of each object, 0 for none.
    """
    in_both = (ids > 0) & (owner > 0)
    width = int(ids.max(initial=0)) + 1
    keys, common_points = np.unique(owner[in_both] * width + ids[in_both], return_counts=True)
    object_ids, cluster_ids = np.divmod(keys, width)
    cluster_sizes, object_sizes = np.bincount(ids, minlength=width), np.bincount(owner, minlength=count + 1)
    iou = common_points / (cluster_sizes[cluster_ids] + object_sizes[object_ids] - common_points)
    cluster_by_object, is_paired = np.zeros(count, np.int64), np.zeros(width, bool)
    for k in np.argsort(-iou, kind="stable"):
        if cluster_by_object[object_ids[k] - 1] == 0 and not is_paired[cluster_ids[k]]:
            cluster_by_object[object_ids[k] - 1], is_paired[cluster_ids[k]] = cluster_ids[k], True
    return cluster_by_object


def _segment(height: float, scan: PointCloud) -> np.ndarray:
    params = with_values(GroundParams(method="cloth"), {"sensor_pose.height": height})
    return segment_ground(scan, params)


def _measure(
    key: str, function: Callable[[np.ndarray], np.ndarray], scan: PointCloud, ground: np.ndarray, objects: Objects
) -> tuple[list[float], float]:
    obstacles = scan.xyz.compress(~ground, axis=0)
    obstacle_ids, ms = _time(key, function, obstacles)
    ids = np.zeros(len(scan), np.int32)
    ids[~ground] = obstacle_ids
    return count_points(ids, ground, objects), ms


_warmed_up: set[str] = set()  # keys of functions whose compiled code this process has loaded


def _time(key: str, function: Callable[[Any], np.ndarray], argument: Any) -> tuple[np.ndarray, float]:
    """Return the result of a function and its duration in milliseconds."""
    if key not in _warmed_up:
        function(argument)
        _warmed_up.add(key)
    start = perf_counter()
    result = function(argument)
    return result, round((perf_counter() - start) * 1e3, 3)
