"""Measurement of the EG-PointPillars experiment on one frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from time import perf_counter, process_time
from typing import Any

import numpy as np

from experiments.framework.precision import to_record
from experiments.framework.trained_models import TrainedModel
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.clustering.shapes import fit_boxes
from lidar_perception.data.frame import Frame
from lidar_perception.detectors.contract import Detector
from lidar_perception.detectors.normalized_view import NormalizedView, segment_view_ground
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.params import MIN_SCORE
from lidar_perception.detectors.pointpillars.config import AHEAD
from lidar_perception.detectors.pointpillars.params import EXPERT_CLUSTERING, EXPERT_GROUND
from lidar_perception.geometry import is_within, points_in_boxes
from lidar_perception.ground.params import SensorPoseParams
from lidar_perception.scoring.kitti.camera_objects import to_camera_objects, to_scored_labels
from lidar_perception.types import SENSOR_HEIGHT, GroundTruth, InputError, PointCloud

MIN_FRACTION = 0.5  # minimum fraction of a cluster's points in a box for the cluster to get the box's class
NO_CLASS = -1


def measure_frame(frames: Sequence[Frame], number: int, models: Mapping[str, TrainedModel]) -> dict[str, Any]:
    """Measure frame `number` and return its record.

    - true: the labels, see precision.to_record()
    - found: network -> its detections, in the same form
    - ms: network -> total time, total CPU time, and time of each step
    - boxes: [class, diagonal] of each label
    - clusters: [class, diagonal] of each cluster; the class is NO_CLASS for background
    """
    frame = frames[number]
    truth, calibration = frame.truth(), frame.calibration()
    if truth is None:
        raise InputError(f"{frame.points or frame.name} has no labels")
    scan = frame.load()
    detections, ms = {}, {}
    names = [*models]
    first = number % max(len(names), 1)  # the order is rotated so that warm caches favour no network
    for name in (*names[first:], *names[:first]):
        detector = open_network(str(models[name].weights), frame.sensor_height)
        start, cpu_start = perf_counter(), process_time()
        result = detector(scan)
        total_ms = {"total": 1e3 * (perf_counter() - start), "cpu": 1e3 * (process_time() - cpu_start)}
        detections[name] = to_record(to_camera_objects(to_scored_labels(result.detections), calibration))
        ms[name] = {step: round(value, 2) for step, value in {**total_ms, **result.timings}.items()}
    return {
        "frame": frame.name,
        "true": to_record(to_camera_objects(truth, calibration)),
        "found": {name: detections[name] for name in names},
        "ms": ms,
        **measure_diagonals(scan, truth, frame.sensor_height),
    }


@lru_cache(maxsize=64)
def open_network(weights: str, sensor_height: float) -> Detector:
    """Open a network with a low threshold for all classes. It is opened and warmed up once per process."""
    return open_detector(weights, sensor_height=sensor_height, min_score=MIN_SCORE)


def measure_diagonals(scan: PointCloud, truth: GroundTruth, sensor_height: float) -> dict[str, list[list[float]]]:
    """Measure the BEV diagonals of labelled boxes and of clusters (Table 2 and Figure 13).

    A cluster gets the class of the box that contains most of its points, provided that the box
    contains at least MIN_FRACTION of them. Only boxes and clusters in the range of the network are used.
    """
    view = NormalizedView.of(scan, SensorPoseParams(height=sensor_height), **AHEAD).frame
    true_boxes = truth.boxes + np.array([0, 0, sensor_height - SENSOR_HEIGHT, 0, 0, 0, 0])
    indices = np.flatnonzero(is_within(true_boxes, AHEAD["low"], AHEAD["high"]))
    true_boxes, classes = true_boxes[indices], truth.class_ids[indices]
    ground = segment_view_ground(view, EXPERT_GROUND)
    ids = cluster_obstacles(view.xyz, ground, EXPERT_CLUSTERING)
    boxes = fit_boxes(view.xyz, ids, "min_area")
    sizes = np.bincount(ids, minlength=len(boxes) + 1)[1:]
    rows, first = points_in_boxes(view.xyz, true_boxes)
    counts = np.stack(
        [np.bincount(ids[rows[first[k] : first[k + 1]]], minlength=len(boxes) + 1)[1:] for k in range(len(true_boxes))]
        or [np.zeros(len(boxes), int)]
    )
    box_indices = counts.argmax(axis=0)
    is_object = counts.max(axis=0) >= np.maximum(MIN_FRACTION * sizes, 1)
    cluster_classes = np.full(len(boxes), NO_CLASS)
    if len(classes):
        cluster_classes[is_object] = classes[box_indices[is_object]]
    return {"boxes": _list_diagonals(classes, true_boxes), "clusters": _list_diagonals(cluster_classes, boxes)}


def _list_diagonals(classes: np.ndarray, boxes: np.ndarray) -> list[list[float]]:
    diagonals = np.hypot(boxes[:, 3], boxes[:, 4])
    return [[int(c), round(float(d), 3)] for c, d in zip(classes, diagonals)]
