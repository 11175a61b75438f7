"""PointNet in inference mode: it classifies clusters, and boxes that another network proposes."""

from __future__ import annotations

import numpy as np

from lidar_perception.detectors.checkpoint import Header
from lidar_perception.detectors.devices import CPU
from lidar_perception.detectors.pointnet.clusters import Clusters, points_of
from lidar_perception.detectors.pointnet.predict import Network, Predictions, predict
from lidar_perception.detectors.trained_network import TrainedNetwork
from lidar_perception.types import CLASSES, Detections, PointCloud

BOX_MARGIN_M = 0.2  # around a box: points in it are classified
MIN_POINTS = 3      # in a box that is classified


class PointNetClassifier(TrainedNetwork):
    """A PointNet for inference."""

    network: Network

    def __init__(self, network: Network, header: Header, device: str = CPU):
        super().__init__(network, header, device)

    def predict(self, clusters: Clusters, labels: np.ndarray | None = None,
                cpu_fallback: bool = True) -> Predictions:
        """Return the predictions for K clusters, see predict.predict."""
        return self.run(lambda: predict(self.network, clusters, labels=labels), cpu_fallback)

    def classify(self, proposals: Detections, obstacles: PointCloud, ground: np.ndarray,
                 selected: np.ndarray, cpu_fallback: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Judge boxes of a NormalizedView by the points in them.

        Args:
            proposals: K boxes with their classes; K may be 0. The result for one does not depend
                on the others.
            obstacles: the points of the view that are not ground.
            ground: (G, 3) xyz of the ground points of the view.
            selected: (K,) bool, the proposals to judge. Skipped are also those of classes that the
                network does not have and those with fewer than MIN_POINTS points.

        Returns:
            Probabilities (K,) that each proposal is of its class, and the boxes (K, 7) that its
            points suggest, both float64 and NaN for skipped proposals.
        """
        clusters = points_of(proposals.boxes, obstacles, BOX_MARGIN_M)
        index_of = {CLASSES.index(name): i for i, name in enumerate(self.classes)}
        labels = np.array([index_of.get(int(i), -1) for i in proposals.class_ids], np.int64)
        chosen = np.flatnonzero(selected & (clusters.sizes >= MIN_POINTS) & (labels >= 0))
        predictions = self.predict(clusters.take(chosen).on(ground), labels[chosen], cpu_fallback)
        count = len(proposals)
        probabilities, boxes = np.full(count, np.nan), np.full((count, 7), np.nan)
        probabilities[chosen], boxes[chosen] = predictions.scores, predictions.boxes
        return probabilities, boxes
