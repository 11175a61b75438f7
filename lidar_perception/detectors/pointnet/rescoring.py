"""The score of a box combined with the probability that the cluster network gives its class."""

from __future__ import annotations

import numpy as np

from lidar_perception.detectors.pointnet.clusters import Clusters
from lidar_perception.detectors.pointnet.detector import PointNetDetector
from lidar_perception.detectors.pointnet.predict import predict
from lidar_perception.detectors.view import in_sensor_frame, levelled, with_intensity_scaled
from lidar_perception.ground.params import SensorPoseParams
from lidar_perception.types import CLASSES, Detections, LidarFrame


def combined(scores: np.ndarray, probabilities: np.ndarray, weight: float) -> np.ndarray:
    """(K,) geometric mean of scores (K,) and probabilities (K,), 0..1: the first alone with weight
    0, the second alone with weight 1, 0 where one of the two that counts is 0."""
    return scores ** (1.0 - weight) * probabilities ** weight


def seen_by(classifier: PointNetDetector, frame: LidarFrame, pose: SensorPoseParams) -> LidarFrame:
    """The frame of a sensor with this pose as the classifier's network reads it."""
    return with_intensity_scaled(levelled(frame, pose), classifier.settings.intensity_scale)


def known(classifier: PointNetDetector, class_ids: np.ndarray) -> np.ndarray:
    """(K,) bool: of class_ids (K,) into CLASSES, those that the network tells apart."""
    return np.isin(class_ids, [CLASSES.index(name) for name in classifier.config.classes])


def rescored_by(classifier: PointNetDetector, detections: Detections, clusters: Clusters,
                weight: float, pose: SensorPoseParams = SensorPoseParams()
                ) -> tuple[Detections, np.ndarray]:
    """The detections with combined scores, and boxes (K, 7) float32 as the network makes them out,
    in the sensor's frame; K may be 0.

    detections: of classes that are known, detection i of the points of cluster i, which are those
    of seen_by. Each is scored by itself.
    """
    names = [CLASSES[i] for i in detections.class_ids]
    labels = np.array([*map(classifier.config.classes.index, names)], np.int64)
    seen = classifier.guarded(lambda: predict(classifier.network, clusters, labels=labels))
    scores = combined(detections.scores, seen.scores.astype(np.float32), weight)
    boxes = in_sensor_frame(Detections.of(seen.boxes), pose).boxes
    return Detections.of(detections.boxes, detections.class_ids, scores), boxes
