"""PointNet in inference mode: classification of clusters and of boxes from another network."""

from __future__ import annotations

import numpy as np

from lidar_perception.detectors.checkpoint import Header
from lidar_perception.detectors.devices import CPU
from lidar_perception.detectors.pointnet.clusters import Clusters, crop_boxes
from lidar_perception.detectors.pointnet.predict import Network, Predictions, predict
from lidar_perception.detectors.trained_network import TrainedNetwork
from lidar_perception.types import CLASSES, Detections, PointCloud

BOX_MARGIN_M = 0.2  # points up to this distance from a box are classified with it
MIN_POINTS = 3  # boxes with fewer points are not classified


class PointNetClassifier(TrainedNetwork):
    """A PointNet for inference."""

    network: Network

    def __init__(self, network: Network, header: Header, device: str = CPU):
        super().__init__(network, header, device)

    def predict(self, clusters: Clusters, labels: np.ndarray | None = None, cpu_fallback: bool = True) -> Predictions:
        """Return the predictions for K clusters, see predict.predict."""
        return self.run(lambda: predict(self.network, clusters, labels=labels), cpu_fallback)

    def classify(
        self,
        proposals: Detections,
        obstacles: PointCloud,
        ground: np.ndarray,
        selected: np.ndarray,
        cpu_fallback: bool = True,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Classify the points in boxes of a NormalizedView.

        Args:
            proposals: K boxes with their classes; K may be 0. Each is classified independently.
            obstacles: non-ground points of the view.
            ground: (G, 3) xyz of the ground points of the view.
            selected: (K,) bool, the proposals to classify. Proposals with a class that the network
                does not have, or with fewer than MIN_POINTS points, are skipped too.

        Returns:
            Probability (K,) that each proposal has its class, and a box (K, 7) from its points,
            both float64 and NaN for skipped proposals.
        """
        clusters = crop_boxes(proposals.boxes, obstacles, BOX_MARGIN_M)
        label_by_class_id = {CLASSES.index(name): i for i, name in enumerate(self.classes)}
        labels = np.array([label_by_class_id.get(int(i), -1) for i in proposals.class_ids], np.int64)
        chosen = np.flatnonzero(selected & (clusters.sizes >= MIN_POINTS) & (labels >= 0))
        predictions = self.predict(clusters.take(chosen).with_ground(ground), labels[chosen], cpu_fallback)
        count = len(proposals)
        probabilities, boxes = np.full(count, np.nan), np.full((count, 7), np.nan)
        probabilities[chosen], boxes[chosen] = predictions.scores, predictions.boxes
        return probabilities, boxes
