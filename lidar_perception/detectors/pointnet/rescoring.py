"""The cluster network's judgement of boxes that another detector proposes."""

from __future__ import annotations

import numpy as np

from lidar_perception.detectors.pointnet.clusters import Clusters
from lidar_perception.detectors.pointnet.detector import PointNetDetector
from lidar_perception.types import CLASSES, Detections


def known(classifier: PointNetDetector, class_ids: np.ndarray) -> np.ndarray:
    """(K,) bool: of class_ids (K,) into CLASSES, those that the network tells apart."""
    return np.isin(class_ids, [CLASSES.index(name) for name in classifier.config.classes])


def class_probabilities(classifier: PointNetDetector, detections: Detections, clusters: Clusters
                        ) -> tuple[np.ndarray, np.ndarray]:
    """Return the probability that the network gives to the class of each detection, and its box.

    Args:
        detections: K of known classes; K may be 0. The probability of one does not depend on the
            others.
        clusters: their points, cluster i those of detection i, as the network reads them.

    Returns:
        Probabilities (K,) float32, and boxes (K, 7) float32 as from a level sensor at
        SENSOR_HEIGHT.
    """
    names = [CLASSES[i] for i in detections.class_ids]
    labels = np.array([*map(classifier.config.classes.index, names)], np.int64)
    seen = classifier.predict(clusters, labels)
    return seen.scores.astype(np.float32), seen.boxes.astype(np.float32)
