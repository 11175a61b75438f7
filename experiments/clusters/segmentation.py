"""Segmentation before any network: measurement of one frame (paper C, Section 3.1)."""

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
    """Values that Table 2 varies one at a time; the paper gives only the best of them.

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


def _euclidean(**changes: Any) -> Callable[[np.ndarray], np.ndarray]:
    params = ClusteringParams(method="euclidean", euclidean=with_values(PAPER, changes))
    return partial(cluster, params=params)


# Name -> function of the points (N, 3) without ground. Differences are relative to the first one.
METHODS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "Euclidean, fixed": _euclidean(threshold="fixed", distance=STUDY.distance, beta=0.0, gamma=0.0),
    "DBSCAN": partial(cluster, params=ClusteringParams(method="dbscan")),
    "range image": cluster_range_image,
    "ours": _euclidean(),
    "ours, Eq. 6": _euclidean(threshold="global"),
    "ours, gamma 0": _euclidean(gamma=0.0),
    "ours, gamma 0, curvature": _euclidean(gamma=0.0, curvature=STUDY.curvature),
}
SWEEPS: dict[str, dict[str, Callable[[np.ndarray], np.ndarray]]] = {
    name: {f"{value:g}": _euclidean(**{name: value}) for value in getattr(STUDY, name)}
    for name in ("alpha", "beta", "gamma")
}
# Result of count_points() for one frame and method.
COUNTS = ("points", "right", "both", "found", "true", "objects", "hits", "judged", "iou")


def measure_segmentation(frame: Frame) -> dict[str, Any]:
    """Cluster the points of a frame by every method, and compare with its labelled boxes.

    The ground is that of the cloth for every method, found in the whole cloud, as are the clusters.
    Only points in the camera's view are compared, if there is a camera, and none in regions
    without labels.

    Returns:
        methods and sweeps: name -> COUNTS, see count_points; and ms: the same names -> duration,
        and that of `ground`.

    Raises:
        InputError: the frame has no labels, or none of its objects has enough points.
    """
    truth = frame.truth()
    if truth is None:
        raise InputError(f"{frame.points or frame.name} has no labels; put the label files next to the scans")
    scan, camera = frame.load(), frame.camera()
    objects = find_objects_in_boxes(scan.xyz, truth)
    if camera is not None:
        seen = camera.in_view(scan.xyz)
        seen[seen] = ~find_unlabelled(truth, camera, scan.xyz[seen])
        objects = select_counted(objects, seen)
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


def select_counted(objects: Objects, seen: np.ndarray) -> Objects:
    """Return the objects with only the points of a mask (N,) to be compared."""
    return Objects(
        np.where(seen, objects.owner, 0),
        np.where(seen, objects.region, 0),
        objects.near & seen,
        objects.counted & seen,
        objects.classes,
        objects.ranges,
    )


def count_points(cluster_ids: np.ndarray, ground: np.ndarray, objects: Objects) -> list[float]:
    """Compare the clusters (N,) of a frame with its objects, point by point.

    Every object is paired with at most one cluster, pairs of the largest IoU first. A point counts
    as found for the object whose cluster it is in, and as right if it belongs there: to that
    object, or to no object and no paired cluster. Ground (N,) bool outside objects and the neutral
    points at the bottom of boxes do not count, or the many points of the road would decide.

    Returns:
        COUNTS: numbers of points that count, that are right, that are right and of an object, that
        are found for an object, that are of an object; and of objects, of hits (IoU above one half)
        and of judged clusters of score_clusters(); and the sum of the IoU of the objects.
    """
    counted = objects.counted & ((objects.owner > 0) | ~ground)
    counted &= (objects.owner > 0) == (objects.region > 0)
    ids, owner = (a.compress(counted).astype(np.int64) for a in (cluster_ids, objects.owner))
    cluster_of = pair_clusters(ids, owner, len(objects.classes))
    object_of = np.zeros(int(ids.max(initial=0)) + 1, np.int64)
    object_of[cluster_of[cluster_of > 0]] = np.flatnonzero(cluster_of > 0) + 1
    found = object_of[ids]
    score = score_clusters(cluster_ids, objects)
    present = np.bincount(owner, minlength=len(objects.classes) + 1)[1:] > 0
    right = found == owner
    return [
        len(ids),
        int(right.sum()),
        int((right & (owner > 0)).sum()),
        int((found > 0).sum()),
        int((owner > 0).sum()),
        int(present.sum()),
        int((score.iou[present] > 0.5).sum()),
        score.judged,
        round(float(score.iou[present].sum()), 6),
    ]


def pair_clusters(ids: np.ndarray, owner: np.ndarray, count: int) -> np.ndarray:
    """Pair objects 1..count with clusters by the points (P,) of both, largest IoU first.

    Returns:
        (count,) the cluster of each object, 0 for none.
    """
    both = (ids > 0) & (owner > 0)
    width = int(ids.max(initial=0)) + 1
    keys, common = np.unique(owner[both] * width + ids[both], return_counts=True)
    thing, cluster_id = np.divmod(keys, width)
    sizes, points = np.bincount(ids, minlength=width), np.bincount(owner, minlength=count + 1)
    iou = common / (sizes[cluster_id] + points[thing] - common)
    cluster_of, taken = np.zeros(count, np.int64), np.zeros(width, bool)
    for k in np.argsort(-iou, kind="stable"):
        if cluster_of[thing[k] - 1] == 0 and not taken[cluster_id[k]]:
            cluster_of[thing[k] - 1], taken[cluster_id[k]] = cluster_id[k], True
    return cluster_of


def _segment(height: float, scan: PointCloud) -> np.ndarray:
    params = with_values(GroundParams(method="cloth"), {"sensor_pose.height": height})
    return segment_ground(scan, params)


def _measure(
    key: str, function: Callable[[np.ndarray], np.ndarray], scan: PointCloud, ground: np.ndarray, objects: Objects
) -> tuple[list[float], float]:
    rest = scan.xyz.compress(~ground, axis=0)
    found, ms = _time(key, function, rest)
    ids = np.zeros(len(scan), np.int32)
    ids[~ground] = found
    return count_points(ids, ground, objects), ms


_warm: set[str] = set()  # keys of functions whose compiled code this process has loaded


def _time(key: str, function: Callable[[Any], np.ndarray], argument: Any) -> tuple[np.ndarray, float]:
    """Return the result of a function and its duration in milliseconds."""
    if key not in _warm:
        function(argument)
        _warm.add(key)
    start = perf_counter()
    result = function(argument)
    return result, round((perf_counter() - start) * 1e3, 3)
