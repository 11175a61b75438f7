"""Class labels of clusters and of their points, and the confusion with a network (paper C)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.camera import Camera
from lidar_perception.classes import DONT_CARE, TABLE
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.data.frame import Frame, Recording
from lidar_perception.detectors.open import default_params
from lidar_perception.detectors.pointnet.clusters import Clusters, make_clusters
from lidar_perception.detectors.pointnet.detector import load_pointnet_detector
from lidar_perception.detectors.pointnet.params import PointNetDetectorParams, PointNetParams
from lidar_perception.detectors.pointnet.predict import Predictions
from lidar_perception.geometry import points_in_box
from lidar_perception.ground.segment import segment_ground
from lidar_perception.param_fields import with_values
from lidar_perception.types import CLASSES, GroundTruth

UNKNOWN = -1  # label of clusters and points that are not scored
MIN_OBJECT_SHARE = 0.5  # minimum fraction of a cluster's points in a box to count as that object
MAX_BACKGROUND_SHARE = 0.15  # maximum fraction of a cluster's points in boxes to count as background
BOX_MARGIN = 0.05  # in metres; points this close to a box belong to it, because labels are rounded
# Classes that resemble a scored class, and DontCare
IGNORED_CLASSES = [row.name for row in TABLE if row.numbers is None and (row.looks_like or row.vehicle)] + [
    CLASSES[DONT_CARE]
]
MIN_POINTS = 10  # clusters with fewer points are ignored


def label_clusters(
    clusters: Clusters, boxes: np.ndarray, class_ids: np.ndarray, classes: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Label K clusters by the box with the largest share of their points.

    Args:
        boxes, class_ids: (M, 7) labelled boxes, and (M,) indices into CLASSES.
        classes: names of the labels.

    Returns:
        Labels (K,) int64 into classes, len(classes) for background, UNKNOWN for neither; and the
        index of the box (K,) int64 of each cluster, -1 for none.
    """
    count, background = len(clusters), len(classes)
    number = np.repeat(np.arange(count), clusters.sizes)
    share, owners = np.zeros(count), np.full(count, -1)
    sizes = np.maximum(clusters.sizes, 1)
    for i, box in enumerate(boxes):
        inside = points_in_box(clusters.points[:, :3], box, BOX_MARGIN)
        part = np.bincount(number[inside], minlength=count) / sizes
        more = part > share
        share[more], owners[more] = part[more], i
    of_boxes = np.append(map_labels(class_ids, classes), background)
    labels = np.where(share >= MIN_OBJECT_SHARE, of_boxes[owners], UNKNOWN)
    labels[share < MAX_BACKGROUND_SHARE] = background
    owners[(labels == UNKNOWN) | (labels == background)] = -1
    return labels, owners


def label_points(xyz: np.ndarray, boxes: np.ndarray, class_ids: np.ndarray, classes: Sequence[str]) -> np.ndarray:
    """Label points (N, 3) by the class of their box, as (N,) int64.

    len(classes) is background, UNKNOWN a box of an ignored class.
    """
    labels = np.full(len(xyz), len(classes))
    for label, box in zip(map_labels(class_ids, classes), boxes):
        labels[points_in_box(xyz, box, BOX_MARGIN)] = label
    return labels


def find_unlabelled(truth: GroundTruth, camera: Camera, xyz: np.ndarray) -> np.ndarray:
    """Return a mask (N,) of the points in regions without labels (DontCare) of the image."""
    regions = [extra["bbox"] for name, extra in truth.notes if name == "DontCare"]
    return camera.in_regions(xyz, np.array(regions, float))


def mask_unlabelled(labels: np.ndarray, clusters: Clusters, unlabelled: np.ndarray, background: int) -> np.ndarray:
    """Set the labels (K,) of background clusters to UNKNOWN if half of their points are unlabelled.

    unlabelled (P,) bool is a mask of the points of all clusters.
    """
    number = np.repeat(np.arange(len(clusters)), clusters.sizes)
    share = np.bincount(number, unlabelled, minlength=len(clusters)) / np.maximum(clusters.sizes, 1)
    return np.where((labels == background) & (share >= 0.5), UNKNOWN, labels)


def map_labels(class_ids: np.ndarray, classes: Sequence[str]) -> np.ndarray:
    """Map class_ids (M,) to labels (M,) int64 into classes.

    len(classes) is background; classes of IGNORED_CLASSES are UNKNOWN.
    """
    return np.array(
        [
            classes.index(name) if name in classes else UNKNOWN if name in IGNORED_CLASSES else len(classes)
            for name in (CLASSES[i] for i in class_ids)
        ],
        np.int64,
    )


def count_confusions(
    clusters: Clusters,
    labels: np.ndarray,
    predictions: Predictions,
    point_truth: np.ndarray,
    cluster_ids: np.ndarray,
    classes: Sequence[str],
) -> tuple[np.ndarray, np.ndarray]:
    """Count the clusters and points of one frame by true and predicted class.

    Args:
        labels: (K,) true labels of the clusters.
        point_truth, cluster_ids: (N,) true label of each point, and its cluster, 0 for none.
        classes: names of the labels.

    Returns:
        Counts of clusters and of points, (K + 1, K + 1) each, with background last.
    """
    shape = len(classes) + 1, len(classes) + 1
    of_clusters, of_points = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
    predicted = predictions.probabilities.argmax(axis=1)
    counted = (labels >= 0) & (clusters.sizes >= MIN_POINTS)
    np.add.at(of_clusters, (labels[counted], predicted[counted]), 1)
    largest = max(int(cluster_ids.max(initial=0)), int(clusters.ids.max(initial=0)))
    of_number = np.full(largest + 1, len(classes))
    of_number[clusters.ids] = predicted
    known = point_truth >= 0
    np.add.at(of_points, (point_truth[known], of_number[cluster_ids[known]]), 1)
    return of_clusters, of_points


def measure_network(weights: Path, settings: Mapping[str, Any], recording: Recording) -> Callable[[Frame], Any]:
    """Run a cluster network on the points in the image of every frame with labelled boxes.

    partial(measure_network, weights, settings) is a Start of scoring.run.

    Args:
        settings: ground and clustering parameters by dotted name that differ from those of
            training.
    """
    classifier = load_pointnet_detector(
        weights, "cpu", PointNetDetectorParams(pointnet=PointNetParams(warm_up=False))
    ).classifier
    config, background = classifier.config, len(classifier.classes)
    params = with_values(default_params(weights), settings)

    def measure(frame: Frame) -> tuple[np.ndarray, np.ndarray] | None:
        truth = frame.truth()
        if truth is None:
            return None
        scan = frame.load()
        ground = segment_ground(scan, params.ground)
        ids = cluster_obstacles(scan.xyz, ground, params.clustering)
        camera = frame.camera()
        if camera is None:  # without a camera, labels cover all directions
            indices, hidden = np.arange(len(scan)), lambda xyz: np.zeros(len(xyz), bool)
        else:
            indices, hidden = (np.flatnonzero(camera.in_view(scan.xyz)), partial(find_unlabelled, truth, camera))
        seen, ids = scan.take(indices), ids[indices]
        made = make_clusters(seen, ids, ground=ground[indices])
        labels, _ = label_clusters(made, truth.boxes, truth.class_ids, config.classes)
        labels = mask_unlabelled(labels, made, hidden(made.points[:, :3]), background)
        points = label_points(seen.xyz, truth.boxes, truth.class_ids, config.classes)
        points[(points == background) & hidden(seen.xyz)] = UNKNOWN
        return count_confusions(made, labels, classifier.predict(made), points, ids, config.classes)

    return measure


@dataclass
class ClusterScores:
    """Confusion of clusters and of points, (K + 1, K + 1) each, by true and predicted class.

    The last row and column is background.
    """

    classes: tuple[str, ...]
    frames: int = 0
    clusters: np.ndarray = field(init=False)
    points: np.ndarray = field(init=False)
    skipped: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        count = len(self.classes) + 1
        self.clusters, self.points = (np.zeros((count, count), np.int64) for _ in range(2))

    def update(self, counts: tuple[np.ndarray, np.ndarray]) -> None:
        """Add the counts of one frame, as returned by count_confusions."""
        self.clusters += counts[0]
        self.points += counts[1]
        self.frames += 1

    def compute(self) -> dict[str, Any]:
        """Return the scores as JSON; shares in percent, None without objects."""
        return {
            "frames": self.frames,
            "classes": [*self.classes, "background"],
            "min_points": MIN_POINTS,
            "clusters": _compute_scores(self.clusters, self.classes),
            "points": _compute_scores(self.points, self.classes),
            "skipped": self.skipped,
        }


def _compute_scores(confusion: np.ndarray, classes: Sequence[str]) -> dict[str, Any]:
    """Compute accuracy, and precision, recall, F1 and IoU by class and as their mean."""
    right = np.diag(confusion)
    true, predicted = confusion.sum(axis=1), confusion.sum(axis=0)
    rows = {}
    for i, name in enumerate(classes):
        rows[name] = {
            "objects": int(true[i]),
            "precision": _to_percent(right[i], predicted[i]),
            "recall": _to_percent(right[i], true[i]),
            "f1": _to_percent(2 * right[i], true[i] + predicted[i]),
            "iou": _to_percent(right[i], true[i] + predicted[i] - right[i]),
        }
    found = [row for row in rows.values() if row["objects"]]
    mean = {
        key: float(np.mean([row[key] or 0.0 for row in found])) if found else None
        for key in ("precision", "recall", "f1", "iou")
    }
    count = len(classes)
    return {
        "confusion": confusion.tolist(),
        "accuracy": _to_percent(right.sum(), confusion.sum()),
        "object_accuracy": _to_percent(right[:count].sum(), true[:count].sum()),
        "by_class": rows,
        "mean": mean,
    }


def _to_percent(part: int, whole: int) -> float | None:
    return 100.0 * float(part) / float(whole) if whole else None
