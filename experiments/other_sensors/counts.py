"""True positives, false positives and misses of a detector on frames of other sensors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lidar_perception.detectors.contract import Detector
from lidar_perception.geometry import centre_distances
from lidar_perception.types import CLASSES, SENSOR_HEIGHT, Detections, PointCloud

MAX_RANGE_M, MIN_POINTS = 40.0, 10  # objects farther away or with fewer points are ignored
# Maximum distance between the centres of a detection and of its label.
MAX_DISTANCE_M = {"Pedestrian": 1.0, "Cyclist": 1.0, "Car": 2.0}
# Data set -> classes that it does not label.
UNLABELLED = {"nuscenes_seg": ("Car", "Cyclist"), "aachen": ("Car", "Cyclist"), "logictronix": ("Cyclist",)}


@dataclass(frozen=True)
class LabelledCloud:
    """A cloud with labels, raised so that the ground is SENSOR_HEIGHT below the origin.

    Attributes:
        dataset, name: Names of the folder and of the file.
        cloud: Cloud with intensity.
        boxes: (K, 7) labelled boxes.
        names: (K,) class of each box.
        points: (K,) number of points in each box.
    """

    dataset: str
    name: str
    cloud: PointCloud
    boxes: np.ndarray
    names: np.ndarray
    points: np.ndarray


@dataclass
class Counts:
    """Numbers of true positives, false positives and misses."""

    tp: int = 0
    fp: int = 0
    fn: int = 0

    def __add__(self, other: Counts) -> Counts:
        return Counts(self.tp + other.tp, self.fp + other.fp, self.fn + other.fn)

    @property
    def f1(self) -> float:
        """F1 in percent; NaN if there are neither objects nor detections."""
        total = 2 * self.tp + self.fp + self.fn
        return 200 * self.tp / total if total else float("nan")


def read_clouds(folder: Path) -> Iterator[LabelledCloud]:
    """Yield the labelled clouds of folder/DATASET/*.npz, in the order of their paths.

    The median height of the bottoms of the labelled boxes is taken as the ground.
    """
    for path in sorted(folder.glob("*/*.npz")):
        with np.load(path, allow_pickle=False) as file:
            points, boxes, names, num = (file[key] for key in ("points", "boxes", "labels", "num"))
        is_counted = _is_counted(boxes, num)
        counted_boxes = boxes[is_counted if is_counted.any() else slice(None)]
        shift = -SENSOR_HEIGHT - np.median(counted_boxes[:, 2] - counted_boxes[:, 5] / 2)
        boxes = boxes + np.array([0, 0, shift, 0, 0, 0, 0])
        cloud = PointCloud(points[:, :3] + np.array([0, 0, shift], np.float32), np.ascontiguousarray(points[:, 3]))
        yield LabelledCloud(path.parent.name, path.stem, cloud, boxes, names.astype(str), num)


def count_detections(labelled_cloud: LabelledCloud, detections: Detections) -> dict[str, Counts]:
    """Count true positives, false positives and misses of each labelled class.

    An object is matched by the detection with the highest score within MAX_DISTANCE_M. Ignored are
    objects with few points or far away, detections near them, and detections beyond MAX_RANGE_M.
    """
    counts = {}
    is_counted = _is_counted(labelled_cloud.boxes, labelled_cloud.points)
    for name, limit in MAX_DISTANCE_M.items():
        if name in UNLABELLED.get(labelled_cloud.dataset, ()):
            continue
        class_detections = detections[detections.class_ids == CLASSES.index(name)]
        class_detections = class_detections[np.argsort(-class_detections.scores, kind="stable")]
        labels = np.flatnonzero(labelled_cloud.names == name)
        distances = centre_distances(class_detections.boxes, labelled_cloud.boxes[labels])
        is_matched = np.zeros(len(labels), bool)
        false_positives = 0
        for row, box in zip(distances, class_detections.boxes):
            unmatched_labels = np.flatnonzero((row <= limit) & ~is_matched)
            if len(unmatched_labels):
                is_matched[unmatched_labels[row[unmatched_labels].argmin()]] = True
            elif np.hypot(box[0], box[1]) < MAX_RANGE_M and not (row <= limit).any():
                false_positives += 1
        true_positives = int((is_matched & is_counted[labels]).sum())
        counts[name] = Counts(true_positives, false_positives, int(is_counted[labels].sum()) - true_positives)
    return counts


def count_all(
    detector: Detector, clouds: list[LabelledCloud], with_intensity: bool = True
) -> dict[tuple[str, str], Counts]:
    """Return the counts by (data set, class), with the recorded intensity or without intensity."""
    sums: dict[tuple[str, str], Counts] = {}
    for labelled_cloud in clouds:
        cloud = labelled_cloud.cloud if with_intensity else replace(labelled_cloud.cloud, intensity=None)
        for name, counts in count_detections(labelled_cloud, detector(cloud).detections).items():
            key = labelled_cloud.dataset, name
            sums[key] = sums.get(key, Counts()) + counts
    return sums


def _is_counted(boxes: np.ndarray, points: np.ndarray) -> np.ndarray:
    return (points >= MIN_POINTS) & (np.hypot(boxes[:, 0], boxes[:, 1]) < MAX_RANGE_M)
