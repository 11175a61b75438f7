"""Labels of clusters and points, and the confusion matrix of a cluster network (paper C)."""

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
from lidar_perception.detectors.open import make_default_params
from lidar_perception.detectors.pointnet.clusters import Clusters, make_clusters
from lidar_perception.detectors.pointnet.detector import load_pointnet_detector
from lidar_perception.detectors.pointnet.params import PointNetDetectorParams, PointNetParams
from lidar_perception.detectors.pointnet.predict import Predictions
from lidar_perception.geometry import points_in_box
from lidar_perception.ground.segment import segment_ground
from lidar_perception.param_fields import with_values
from lidar_perception.types import CLASSES, GroundTruth

UNKNOWN = -1  # label of clusters and points that are not scored
MIN_OBJECT_FRACTION = 0.5  # minimum fraction of a cluster's points in the box of its object
MAX_BACKGROUND_FRACTION = 0.15  # maximum fraction of a background cluster's points in a box
BOX_MARGIN = 0.05  # margin of boxes in metres, because labels are rounded
# Classes that resemble a scored class, and DontCare.
IGNORED_CLASSES = [row.name for row in TABLE if row.numbers is None and (row.looks_like or row.vehicle)] + [
    CLASSES[DONT_CARE]
]
MIN_POINTS = 10  # minimum number of points of a scored cluster


def label_clusters(
    clusters: Clusters, boxes: np.ndarray, class_ids: np.ndarray, classes: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Label K clusters by the box that contains most of their points.

    Args:
        clusters: K clusters.
        boxes: (M, 7) labelled boxes.
        class_ids: (M,) indices into CLASSES.
        classes: Names of the labels.

    Returns:
        Labels (K,) int64: index into classes, len(classes) for background, UNKNOWN for clusters that
        are not scored; and the index (K,) int64 of each cluster's box, -1 for none.
    """
    count, background = len(clusters), len(classes)
    cluster_index = np.repeat(np.arange(count), clusters.sizes)
    best_fraction, owners = np.zeros(count), np.full(count, -1)
    sizes = np.maximum(clusters.sizes, 1)
    for i, box in enumerate(boxes):
        in_box = points_in_box(clusters.points[:, :3], box, BOX_MARGIN)
        fraction = np.bincount(cluster_index[in_box], minlength=count) / sizes
        is_better = fraction > best_fraction
        best_fraction[is_better], owners[is_better] = fraction[is_better], i
    label_of_box = np.append(map_labels(class_ids, classes), background)
    labels = np.where(best_fraction >= MIN_OBJECT_FRACTION, label_of_box[owners], UNKNOWN)
    labels[best_fraction < MAX_BACKGROUND_FRACTION] = background
    owners[(labels == UNKNOWN) | (labels == background)] = -1
    return labels, owners


def label_points(xyz: np.ndarray, boxes: np.ndarray, class_ids: np.ndarray, classes: Sequence[str]) -> np.ndarray:
    """Label points (N, 3) by the class of the box that contains them, as (N,) int64.

    Points outside all boxes get len(classes) (background), points in a box of an ignored class get
    UNKNOWN.
    """
    labels = np.full(len(xyz), len(classes))
    for label, box in zip(map_labels(class_ids, classes), boxes):
        labels[points_in_box(xyz, box, BOX_MARGIN)] = label
    return labels


def find_unlabelled(truth: GroundTruth, camera: Camera, xyz: np.ndarray) -> np.ndarray:
    """Return a mask (N,) of the points in DontCare regions of the image."""
    regions = [extra["bbox"] for name, extra in truth.notes if name == "DontCare"]
    return camera.in_regions(xyz, np.array(regions, float))


def set_unlabelled_to_unknown(
    labels: np.ndarray, clusters: Clusters, is_unlabelled: np.ndarray, background: int
) -> np.ndarray:
    """Return labels (K,) in which background clusters in unlabelled regions are UNKNOWN.

    Args:
        labels: (K,) labels of the clusters.
        clusters: K clusters.
        is_unlabelled: (P,) bool, points of the clusters that are in an unlabelled region. A cluster
            is in such a region if at least half of its points are.
        background: Label of the background.
    """
    cluster_index = np.repeat(np.arange(len(clusters)), clusters.sizes)
    fraction = np.bincount(cluster_index, is_unlabelled, minlength=len(clusters)) / np.maximum(clusters.sizes, 1)
    return np.where((labels == background) & (fraction >= 0.5), UNKNOWN, labels)


def map_labels(class_ids: np.ndarray, classes: Sequence[str]) -> np.ndarray:
    """Map class_ids (M,), indices into CLASSES, to labels (M,) int64, indices into classes.

    IGNORED_CLASSES become UNKNOWN. All others that are not in classes become len(classes) (background).
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
        clusters: Clusters of the frame.
        labels: (K,) true labels of the clusters.
        predictions: Predicted classes of the clusters.
        point_truth: (N,) true label of each point.
        cluster_ids: (N,) cluster of each point, 0 for none.
        classes: Names of the C labels.

    Returns:
        Counts of clusters and of points, each (C + 1, C + 1) with background last.
    """
    shape = len(classes) + 1, len(classes) + 1
    cluster_counts, point_counts = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
    predicted_classes = predictions.probabilities.argmax(axis=1)
    is_scored = (labels >= 0) & (clusters.sizes >= MIN_POINTS)
    np.add.at(cluster_counts, (labels[is_scored], predicted_classes[is_scored]), 1)
    largest = max(int(cluster_ids.max(initial=0)), int(clusters.ids.max(initial=0)))
    class_of_id = np.full(largest + 1, len(classes))
    class_of_id[clusters.ids] = predicted_classes
    is_labelled = point_truth >= 0
    np.add.at(point_counts, (point_truth[is_labelled], class_of_id[cluster_ids[is_labelled]]), 1)
    return cluster_counts, point_counts


def measure_network(weights: Path, settings: Mapping[str, Any], recording: Recording) -> Callable[[Frame], Any]:
    """Make a function that runs a cluster network on every frame with labelled boxes.

    Only points in the camera's image are used if the frame has a calibration.
    partial(measure_network, weights, settings) is a StartMeasurement of scoring.run.

    Args:
        weights: Checkpoint of the network.
        settings: Ground and clustering parameters that differ from training, by dotted name.
        recording: The recording.
    """
    classifier = load_pointnet_detector(
        weights, "cpu", PointNetDetectorParams(pointnet=PointNetParams(warm_up=False))
    ).classifier
    config, background = classifier.config, len(classifier.classes)
    params = with_values(make_default_params(weights), settings)

    def measure(frame: Frame) -> tuple[np.ndarray, np.ndarray] | None:
        truth = frame.truth()
        if truth is None:
            return None
        scan = frame.load()
        ground = segment_ground(scan, params.ground)
        ids = cluster_obstacles(scan.xyz, ground, params.clustering)
        camera = frame.camera()
        if camera is None:  # labels cover all directions
            indices, find_unlabelled_points = np.arange(len(scan)), lambda xyz: np.zeros(len(xyz), bool)
        else:
            indices, find_unlabelled_points = (
                np.flatnonzero(camera.in_view(scan.xyz)),
                partial(find_unlabelled, truth, camera),
            )
        view_cloud, ids = scan.take(indices), ids[indices]
        clusters = make_clusters(view_cloud, ids, ground=ground[indices])
        labels, _ = label_clusters(clusters, truth.boxes, truth.class_ids, config.classes)
        labels = set_unlabelled_to_unknown(labels, clusters, find_unlabelled_points(clusters.points[:, :3]), background)
        point_labels = label_points(view_cloud.xyz, truth.boxes, truth.class_ids, config.classes)
        point_labels[(point_labels == background) & find_unlabelled_points(view_cloud.xyz)] = UNKNOWN
        return count_confusions(clusters, labels, classifier.predict(clusters), point_labels, ids, config.classes)

    return measure


@dataclass
class ClusterScores:
    """Confusion matrices of clusters and of points, each (K + 1, K + 1).

    Rows are true classes, columns are predicted classes; the last ones are background.
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
        """Return the content of the JSON file. Ratios are in percent, None if the denominator is 0."""
        return {
            "frames": self.frames,
            "classes": [*self.classes, "background"],
            "min_points": MIN_POINTS,
            "clusters": _compute_scores(self.clusters, self.classes),
            "points": _compute_scores(self.points, self.classes),
            "skipped": self.skipped,
        }


def _compute_scores(confusion: np.ndarray, classes: Sequence[str]) -> dict[str, Any]:
    """Compute accuracy, and precision, recall, F1 and IoU for each class and averaged over classes."""
    correct_counts = np.diag(confusion)
    true_counts, predicted_counts = confusion.sum(axis=1), confusion.sum(axis=0)
    rows = {}
    for i, name in enumerate(classes):
        rows[name] = {
            "objects": int(true_counts[i]),
            "precision": _to_percent(correct_counts[i], predicted_counts[i]),
            "recall": _to_percent(correct_counts[i], true_counts[i]),
            "f1": _to_percent(2 * correct_counts[i], true_counts[i] + predicted_counts[i]),
            "iou": _to_percent(correct_counts[i], true_counts[i] + predicted_counts[i] - correct_counts[i]),
        }
    present_rows = [row for row in rows.values() if row["objects"]]
    mean = {
        key: float(np.mean([row[key] or 0.0 for row in present_rows])) if present_rows else None
        for key in ("precision", "recall", "f1", "iou")
    }
    count = len(classes)
    return {
        "confusion": confusion.tolist(),
        "accuracy": _to_percent(correct_counts.sum(), confusion.sum()),
        "object_accuracy": _to_percent(correct_counts[:count].sum(), true_counts[:count].sum()),
        "by_class": rows,
        "mean": mean,
    }


def _to_percent(numerator: int, denominator: int) -> float | None:
    return 100.0 * float(numerator) / float(denominator) if denominator else None
