"""What each source says of every place where something may be.

Places come from two sources: PointPillars' proposals, and clusters that may be people where it
proposes none. Then every source is asked about each of them. Everything is in the frame of a level
sensor at SENSOR_HEIGHT.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logit

from lidar_perception.candidates.confidence import confidence, shape_features
from lidar_perception.candidates.configurations import BEST
from lidar_perception.candidates.segmented import grounded_boxes
from lidar_perception.classes import CAR, CYCLIST
from lidar_perception.detectors.fused.params import FusedParams
from lidar_perception.detectors.hybrid.rescoring import known
from lidar_perception.detectors.pointnet.clusters import Clusters
from lidar_perception.detectors.pointnet.detector import PointNetDetector
from lidar_perception.detectors.pointnet.predict import predict
from lidar_perception.geometry import points_in_boxes
from lidar_perception.groups import group_points
from lidar_perception.types import CLASSES, PEDESTRIAN, Detections

HEIGHTS, LENGTH = (0.8, 2.6), 2.8  # metres, of clusters that may be a person or a cyclist
MARGIN = 0.2                # metres around a proposal: its points, for the classifier
FEWEST = 3                  # points that it says something of
LEAST, MOST = 0.001, 0.999  # probabilities: no source is certain


@dataclass(frozen=True)
class Hypotheses:
    """K places where something may be, K may be 0: boxes (K, 7) float64, class_ids (K,) into
    CLASSES, and by source the log-odds (K,) float64 that it is there, NaN where a source is
    silent."""

    boxes: np.ndarray
    class_ids: np.ndarray
    evidence: dict[str, np.ndarray]


@dataclass(frozen=True)
class People:
    """K clusters that may be people or cyclists: boxes (K, 7) that stand on the ground, their
    points, and the probabilities (K,) that they are pedestrians, by their silhouettes."""

    boxes: np.ndarray
    clusters: Clusters
    confidences: np.ndarray

    def take(self, chosen: np.ndarray) -> People:
        """Those at indices (M,)."""
        return People(self.boxes[chosen], self.clusters.take(chosen), self.confidences[chosen])


def people_among(points: np.ndarray, ground: np.ndarray, cluster_ids: np.ndarray) -> People:
    """Those among the clusters 1..K of points (N, 4) [x y z intensity], ground (N,) bool,
    cluster_ids (N,), that are neither too high or low nor too long."""
    xyz = points[:, :3]
    boxes = grounded_boxes(xyz, ground, cluster_ids, BEST.boxes.shape)
    chosen = np.flatnonzero((boxes[:, 5] >= HEIGHTS[0]) & (boxes[:, 5] <= HEIGHTS[1])
                            & (boxes[:, 3:5].max(axis=1, initial=0.0) <= LENGTH))
    own, first = group_points(points, cluster_ids, chosen + 1)
    boxes = boxes[chosen]
    return People(boxes, Clusters(own, first, chosen + 1),
                  confidence(shape_features(own[:, :3], first, boxes, BEST)))


def hypotheses(proposed: Detections, people: People, points: np.ndarray, ground: np.ndarray,
               classifier: PointNetDetector, params: FusedParams) -> Hypotheses:
    """Every place, with what is known of it. points (N, 4) [x y z intensity], ground (N,) bool."""
    obstacles = points.compress(~ground, axis=0)
    alone = people.take(np.flatnonzero(
        distances(people.boxes, proposed.boxes[proposed.class_ids != CAR]).min(
            axis=1, initial=np.inf) > params.same_place))
    class_ids = np.append(proposed.class_ids, np.where(
        alone.confidences >= params.min_confidence, PEDESTRIAN, CYCLIST)).astype(np.int64)
    inside, first = points_in_boxes(obstacles, proposed.boxes, MARGIN)
    probabilities, boxes = judged(
        joined(Clusters(obstacles[inside], first, np.arange(len(proposed))), alone.clusters),
        class_ids, points.compress(ground, axis=0)[:, :3], classifier)
    boxes[:len(proposed)] = proposed.boxes
    network = np.append(proposed.scores, np.zeros(len(alone.boxes)))
    kept = np.flatnonzero((network > 0) | (class_ids == PEDESTRIAN)
                          | (probabilities >= params.min_probability))
    near = distances(boxes[kept], people.boxes) <= params.same_place
    return Hypotheses(boxes[kept], class_ids[kept], {
        "network": log_odds(network[kept]),
        "classifier": log_odds(probabilities[kept]),
        "silhouette": log_odds((near * people.confidences).max(axis=1, initial=0.0))})


def judged(clusters: Clusters, class_ids: np.ndarray, ground: np.ndarray,
           classifier: PointNetDetector) -> tuple[np.ndarray, np.ndarray]:
    """The probability (K,) that each of K clusters is of class class_ids[k], and its box (K, 7)
    float64 if it is; NaN where the classifier does not know the class, or there are less than
    FEWEST points. ground (G, 3)."""
    probabilities, boxes = np.full(len(clusters), np.nan), np.full((len(clusters), 7), np.nan)
    asked = np.flatnonzero((clusters.sizes >= FEWEST) & known(classifier, class_ids))
    labels = np.array([classifier.classes.index(CLASSES[i]) for i in class_ids[asked]], np.int64)
    seen = classifier.guarded(
        lambda: predict(classifier.network, clusters.take(asked).on(ground), labels=labels))
    probabilities[asked], boxes[asked] = seen.scores, seen.boxes
    return probabilities, boxes


def joined(a: Clusters, b: Clusters) -> Clusters:
    """The clusters of both, without what is known of the ground."""
    return Clusters(np.concatenate([a.points, b.points]),
                    np.concatenate([a.first, a.first[-1] + b.first[1:]]),
                    np.concatenate([a.ids, b.ids]))


def distances(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(K, M) metres from above between the centres of boxes (K, 7) and others (M, 7)."""
    return np.hypot(*(boxes[:, None, :2] - others[None, :, :2]).transpose(2, 0, 1))


def log_odds(probabilities: np.ndarray) -> np.ndarray:
    """(K,) float64; NaN stays."""
    return logit(np.clip(np.asarray(probabilities, np.float64), LEAST, MOST))
