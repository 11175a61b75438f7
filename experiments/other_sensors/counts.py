"""Found, false and missed objects of a detector on the frames of other sensors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lidar_perception.detectors.contract import Detector
from lidar_perception.geometry import centre_distances
from lidar_perception.types import CLASSES, SENSOR_HEIGHT, Detections, PointCloud

MAX_RANGE_M, MIN_POINTS = 40.0, 10  # limits of the objects that must be detected
# Maximum distance from a detection's centre to its label.
MAX_DISTANCE_M = {"Pedestrian": 1.0, "Cyclist": 1.0, "Car": 2.0}
# Data set -> classes that it does not label.
UNLABELLED = {"nuscenes_seg": ("Car", "Cyclist"), "aachen": ("Car", "Cyclist"), "logictronix": ("Cyclist",)}


@dataclass(frozen=True)
class LabelledCloud:
    """A cloud with labels, raised so that the ground is SENSOR_HEIGHT below the origin.

    Attributes:
        dataset, name: folder and file.
        cloud: the cloud, with an intensity.
        boxes: (K, 7) labelled boxes; names (K,) their classes; points (K,) points in each.
    """

    dataset: str
    name: str
    cloud: PointCloud
    boxes: np.ndarray
    names: np.ndarray
    points: np.ndarray


@dataclass
class Counts:
    """Objects found, false detections and objects missed; scores of detections, right or not."""

    found: int = 0
    false: int = 0
    missed: int = 0

    def __add__(self, other: Counts) -> Counts:
        return Counts(self.found + other.found, self.false + other.false, self.missed + other.missed)

    @property
    def f1(self) -> float:
        """F1 in percent, NaN without objects and detections."""
        total = 2 * self.found + self.false + self.missed
        return 200 * self.found / total if total else float("nan")


def read_clouds(folder: Path) -> Iterator[LabelledCloud]:
    """Yield the labelled clouds of folder/DATASET/*.npz, in the order of their paths.

    The height of the sensor is that of the median labelled box that counts.
    """
    for path in sorted(folder.glob("*/*.npz")):
        with np.load(path, allow_pickle=False) as file:
            points, boxes, names, num = (file[key] for key in ("points", "boxes", "labels", "num"))
        counted = _is_counted(boxes, num)
        bottoms = boxes[counted if counted.any() else slice(None)]
        lift = -SENSOR_HEIGHT - np.median(bottoms[:, 2] - bottoms[:, 5] / 2)
        boxes = boxes + np.array([0, 0, lift, 0, 0, 0, 0])
        cloud = PointCloud(points[:, :3] + np.array([0, 0, lift], np.float32), np.ascontiguousarray(points[:, 3]))
        yield LabelledCloud(path.parent.name, path.stem, cloud, boxes, names.astype(str), num)


def count_detections(labelled: LabelledCloud, detections: Detections) -> dict[str, Counts]:
    """Return the counts of each labelled class.

    The best detection within MAX_DISTANCE_M of an object finds it. Detections beyond MAX_RANGE_M
    and those at an object with few points or far away do not count.
    """
    counts = {}
    counted = _is_counted(labelled.boxes, labelled.points)
    for name, limit in MAX_DISTANCE_M.items():
        if name in UNLABELLED.get(labelled.dataset, ()):
            continue
        own = detections[detections.class_ids == CLASSES.index(name)]
        own = own[np.argsort(-own.scores, kind="stable")]
        labels = np.flatnonzero(labelled.names == name)
        near = centre_distances(own.boxes, labelled.boxes[labels])
        taken = np.zeros(len(labels), bool)
        false = 0
        for row, box in zip(near, own.boxes):
            free = np.flatnonzero((row <= limit) & ~taken)
            if len(free):
                taken[free[row[free].argmin()]] = True
            elif np.hypot(box[0], box[1]) < MAX_RANGE_M and not (row <= limit).any():
                false += 1
        found = int((taken & counted[labels]).sum())
        counts[name] = Counts(found, false, int(counted[labels].sum()) - found)
    return counts


def count_all(
    detector: Detector, clouds: list[LabelledCloud], with_intensity: bool = True
) -> dict[tuple[str, str], Counts]:
    """Return the counts by (data set, class), with the intensity as recorded or without."""
    sums: dict[tuple[str, str], Counts] = {}
    for labelled in clouds:
        cloud = labelled.cloud if with_intensity else replace(labelled.cloud, intensity=None)
        for name, counts in count_detections(labelled, detector(cloud).detections).items():
            key = labelled.dataset, name
            sums[key] = sums.get(key, Counts()) + counts
    return sums


def _is_counted(boxes: np.ndarray, points: np.ndarray) -> np.ndarray:
    return (points >= MIN_POINTS) & (np.hypot(boxes[:, 0], boxes[:, 1]) < MAX_RANGE_M)
