"""Classification of clusters, and of boxes from another network, by PointNet."""

from __future__ import annotations

import numpy as np

from lidar_perception.detectors.pointnet.clusters import Clusters, crop_boxes
from lidar_perception.detectors.pointnet.predict import Network, Predictions, predict
from lidar_perception.detectors.trained_network import TrainedNetwork
from lidar_perception.types import CLASSES, Detections, PointCloud

BOX_MARGIN_M = 0.2  # points up to this distance outside a box are classified with it
MIN_POINTS = 3  # minimum number of points to classify a box


class PointNetClassifier(TrainedNetwork):
    """A PointNet in inference mode."""

    network: Network

    def predict(self, clusters: Clusters, labels: np.ndarray | None = None, cpu_fallback: bool = True) -> Predictions:
        """Return the predictions for K clusters, see predict.predict."""
        return self.run(lambda: predict(self.network, clusters, labels=labels), cpu_fallback)

    def classify(
        self,
        proposals: Detections,
        obstacles: PointCloud,
        ground: np.ndarray,
        mask: np.ndarray,
        cpu_fallback: bool = True,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Classify the points in boxes of a NormalizedView.

        Args:
            proposals: K boxes with their classes, which are classified independently; K may be 0.
            obstacles: non-ground points of the view.
            ground: (G, 3) xyz of the ground points of the view.
            mask: (K,) bool, the proposals to classify. Proposals with fewer than MIN_POINTS points
                or a class that the network does not have are skipped too.

        Returns:
            Probability (K,) that each proposal has its class, and boxes (K, 7) predicted from the
            points; both are float64, and NaN for skipped proposals.
        """
        clusters = crop_boxes(proposals.boxes, obstacles, BOX_MARGIN_M)
        label_by_class_id = {CLASSES.index(name): i for i, name in enumerate(self.classes)}
        labels = np.array([label_by_class_id.get(int(i), -1) for i in proposals.class_ids], np.int64)
        indices = np.flatnonzero(mask & (clusters.sizes >= MIN_POINTS) & (labels >= 0))
        predictions = self.predict(clusters.take(indices).with_ground(ground), labels[indices], cpu_fallback)
        count = len(proposals)
        probabilities, boxes = np.full(count, np.nan), np.full((count, 7), np.nan)
        probabilities[indices], boxes[indices] = predictions.scores, predictions.boxes
        return probabilities, boxes
