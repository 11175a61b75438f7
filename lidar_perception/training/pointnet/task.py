"""Training task of PointNet: samples, loss and validation."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from lidar_perception.camera import Calibration
from lidar_perception.detectors.normalized_view import restore_detections
from lidar_perception.detectors.params import MIN_SCORE
from lidar_perception.detectors.pointnet.box_head import BoxTargets, encode
from lidar_perception.detectors.pointnet.calibration import calibrate, compute_calibration_error
from lidar_perception.detectors.pointnet.clusters import ClusterInput, Clusters, compute_centroids, make_network_input
from lidar_perception.detectors.pointnet.config import PointNetConfig
from lidar_perception.detectors.pointnet.losses import compute_cluster_loss
from lidar_perception.detectors.pointnet.network import PointNet
from lidar_perception.detectors.pointnet.predict import predict, select_detections
from lidar_perception.detectors.pointnet.torch_network import TorchPointNet, run_network
from lidar_perception.geometry import points_in_box
from lidar_perception.ground.params import SensorPoseParams
from lidar_perception.runs.terminal import show_progress
from lidar_perception.scoring.detections import FrameDetections
from lidar_perception.scoring.kitti.report import DetectionReport
from lidar_perception.training.augment import add_range_noise, distort_intensity, vary_background
from lidar_perception.training.params import ClusterAugmentParams
from lidar_perception.training.pointnet.cut_scenes import MIN_POINTS_LEFT, CutScene, CutScenes
from lidar_perception.training.record import summarize_report
from lidar_perception.training.run import Validation
from lidar_perception.types import SENSOR_HEIGHT, GroundTruth, InputError

MIN_SCORED_POINTS = 10  # minimum points of a cluster that is included in the accuracy


@dataclass(frozen=True)
class ClusterSample:
    """Training sample of K clusters.

    Attributes:
        inputs: Input of the network.
        labels: (K,) int64 classes.
        targets: Encoded boxes.
        has_box: (K,) bool, True for objects, whose box target is valid.
    """

    inputs: ClusterInput
    labels: np.ndarray
    targets: BoxTargets[np.ndarray]
    has_box: np.ndarray


@dataclass(frozen=True)
class ClusterPreparation:
    """Function (scene, rng) that draws and augments random clusters of a scene to make a ClusterSample.

    Attributes:
        config: Configuration of the network.
        augment: Numbers of clusters, and limits of the augmentation.
        with_decoys: True to draw up to half of the background clusters from the decoys.
    """

    config: PointNetConfig
    augment: ClusterAugmentParams
    with_decoys: bool = False

    def __call__(self, scene: CutScene, rng: np.random.Generator) -> ClusterSample:
        """Make the sample of a scene. Raise InputError if the scene has no usable cluster."""
        indices = self._draw_clusters(scene, rng)
        if len(indices) == 0:
            raise InputError("a scene has no cluster to train on")
        labels, boxes = scene.labels[indices], scene.boxes[indices].copy()
        clusters = scene.clusters.take(indices)
        background = np.flatnonzero(labels == len(self.config.classes))
        feet = np.column_stack([compute_centroids(clusters.points, clusters.first), clusters.floor])
        for k in background:
            rows = slice(clusters.first[k], clusters.first[k + 1])
            clusters.points[rows], _ = vary_background(clusters.points[rows], feet[k], self.augment, rng)
        clusters, boxes = augment_clusters(clusters, boxes, scene.is_box_crop[indices], self.augment, rng)
        inputs = make_network_input(
            clusters, self.config.points, int(rng.integers(1 << 30)), self.config.farthest_count
        )
        has_box = (labels >= 0) & (labels < len(self.config.classes))
        classes = np.where(has_box, labels, 0)
        targets = encode(boxes, classes, inputs.centres, inputs.azimuths, self.config)
        return ClusterSample(inputs, labels, targets, has_box)

    def _draw_clusters(self, scene: CutScene, rng: np.random.Generator) -> np.ndarray:
        """Draw clusters of each class and of the background, up to the numbers in self.augment."""
        indices_by_class = []
        for label in range(len(self.config.classes) + 1):
            limit = self.augment.background if label == len(self.config.classes) else self.augment.objects
            indices = rng.permutation(np.flatnonzero(scene.labels == label))
            if self.with_decoys and label == len(self.config.classes):
                decoys = indices[scene.is_box_crop[indices]][: limit // 2]
                indices = np.concatenate([decoys, indices[~scene.is_box_crop[indices]]])
            indices_by_class.append(indices[:limit])
        return np.sort(np.concatenate(indices_by_class))


def augment_clusters(
    clusters: Clusters,
    boxes: np.ndarray,
    is_box_crop: np.ndarray,
    params: ClusterAugmentParams,
    rng: np.random.Generator,
) -> tuple[Clusters, np.ndarray]:
    """Augment clusters.

    All clusters are flipped and scaled in the same way. Each one loses points, gets noise, and may
    be moved farther away, which removes more points. Box crops are cut again with a shifted box.

    Args:
        clusters: K clusters, which are not changed.
        boxes: (K, 7) boxes.
        is_box_crop: (K,) bool, see CutScene.

    Returns:
        The changed clusters and boxes.
    """
    count = len(clusters)
    cluster_of_point = np.repeat(np.arange(count), clusters.sizes)
    points, boxes = clusters.points.copy(), boxes.copy()
    keep = np.ones(len(points), bool)
    for k in np.flatnonzero(is_box_crop):
        rows = slice(clusters.first[k], clusters.first[k + 1])
        shifted_box = boxes[k] + rng.normal(0, params.box_shift, 7) * [1, 1, 0.5, 0, 0, 0, 0.3]
        shifted_box[3:6] *= rng.uniform(0.9, 1.15, 3)
        keep[rows] = points_in_box(points[rows, :3], shifted_box)
    range_factors = np.where(rng.random(count) < 0.3, rng.uniform(1, 1 + params.farther, count), 1.0)
    fractions = np.where(rng.random(count) < 0.5, rng.uniform(1 - params.dropout, 1, count), 1.0)
    keep &= rng.random(len(points)) < (fractions / range_factors**2)[cluster_of_point]
    sizes = np.bincount(cluster_of_point[keep], minlength=count)
    keep |= (sizes < MIN_POINTS_LEFT)[cluster_of_point]
    range_factors = np.where(sizes < MIN_POINTS_LEFT, 1.0, range_factors)
    centres = _compute_group_means(points[:, :2].astype(np.float64), cluster_of_point, count)
    shifts = centres * (range_factors - 1)[:, None]
    points[:, :2] += shifts[cluster_of_point].astype(np.float32)
    boxes[:, :2] += shifts
    scale = 1 + rng.uniform(-params.scale, params.scale)
    height = rng.uniform(-params.height, params.height)
    floor = clusters.floor
    points[:, 2] -= floor[cluster_of_point].astype(np.float32)
    boxes[:, 2] -= floor
    points[:, :3] *= np.float32(scale)
    boxes[:, :6] *= scale
    points[:, 2] += floor[cluster_of_point].astype(np.float32)
    boxes[:, 2] += floor
    # The estimated ground height has errors too.
    floor = floor + height + rng.uniform(-0.5, 0.5, count) * params.height
    if rng.random() < params.flip:
        points[:, 1] *= -1
        boxes[:, [1, 6]] *= -1
    points = add_range_noise(points, params, rng)
    gain = rng.uniform(1 - params.intensity, 1 + params.intensity)
    points[:, 3] = np.clip(points[:, 3] * gain, 0, 1)
    points = distort_intensity(points, params, rng)
    sizes = np.bincount(cluster_of_point[keep], minlength=count)
    first = np.concatenate([[0], np.cumsum(sizes)])
    return Clusters(points[keep], first, clusters.ids, floor), boxes


def _compute_group_means(values: np.ndarray, groups: np.ndarray, count: int) -> np.ndarray:
    """Return the mean (count, D) of the values (P, D) in each group, 0 for empty groups. groups: (P,) group indices."""
    sums = np.stack([np.bincount(groups, column, minlength=count) for column in values.T], axis=1)
    return sums / np.maximum(np.bincount(groups, minlength=count), 1)[:, None]


def make_loss(config: PointNetConfig, device: torch.device) -> Callable:
    """Return loss(network, samples) -> (total, parts), see Task."""

    def tensor(arrays: Sequence[np.ndarray]) -> Tensor:
        return torch.from_numpy(np.concatenate(arrays)).to(device)

    def loss(network: nn.Module, samples: Sequence[ClusterSample]) -> tuple[Tensor, dict[str, Tensor]]:
        inputs = [s.inputs for s in samples]
        outputs = network(
            tensor([i.points for i in inputs]), tensor([i.valid for i in inputs]), tensor([i.context for i in inputs])
        )
        targets = BoxTargets(*(tensor(parts) for parts in zip(*(s.targets for s in samples))))
        losses = compute_cluster_loss(
            outputs, tensor([s.labels for s in samples]), targets, tensor([s.has_box for s in samples])
        )
        return losses.total, {
            "classes": losses.classes.detach(),
            "boxes": losses.boxes.detach(),
            "yaw_bins": losses.yaw_bins.detach(),
        }

    return loss


@dataclass(frozen=True)
class ValidationClusters:
    """Validation scene with K clusters.

    Attributes:
        name: Name of the frame.
        clusters: The clusters, without box crops.
        labels: (K,) int64, see CutScene.
        truth: Labels of the frame.
        calibration: Camera of the frame, or None.
        height: Height of the sensor in metres.
    """

    name: str
    clusters: Clusters
    labels: np.ndarray
    truth: GroundTruth | None
    calibration: Calibration | None
    height: float = SENSOR_HEIGHT


def load_validation_clusters(source: CutScenes, i: int) -> ValidationClusters:
    """Load scene i of a source. Raise InputError if it cannot be read."""
    scene = source.load_scene(i)
    indices = np.flatnonzero(~scene.is_box_crop)
    frame = source.load_frame(i)
    return ValidationClusters(
        frame.name,
        scene.clusters.take(indices),
        scene.labels[indices],
        frame.truth(),
        frame.calibration(),
        frame.sensor_height,
    )


def validate_network(network: PointNet, scenes: Sequence[ValidationClusters]) -> Validation:
    """Calibrate the network on one or more scenes, and evaluate it.

    Returns:
        Metrics and calibration, see Task.validate. `score` is the mean BEV AP at the relaxed
        overlaps (moderate, R40). `accuracy` is the percentage of clusters with at least
        MIN_SCORED_POINTS points whose class is correct; `object_accuracy` is the same for objects
        only. Both are NaN if there are no such clusters.
    """
    config = network.config
    labels = np.concatenate([s.labels for s in scenes])
    sizes = np.concatenate([s.clusters.sizes for s in scenes])
    if len(labels):
        logits = torch.cat(
            [
                run_network(
                    network, make_network_input(s.clusters, config.points, farthest_count=config.farthest_count)
                ).logits.cpu()
                for s in scenes
                if len(s.clusters)
            ]
        )
        calibrate(network, logits, torch.from_numpy(labels))
    report, predictions = DetectionReport(), []
    for scene in show_progress(scenes, "validating", len(scenes)):
        predictions.append(predict(TorchPointNet(network), scene.clusters))
        boxes = select_detections(predictions[-1], config, [MIN_SCORE] * len(config.classes))
        boxes = restore_detections(boxes, SensorPoseParams(height=scene.height))
        report.update(FrameDetections(scene.name, scene.truth, boxes, scene.calibration))
    metrics, calibration = summarize_report(report, "bev", config.classes)
    is_scored = (labels >= 0) & (sizes >= MIN_SCORED_POINTS)
    probabilities, labels = np.concatenate([p.probabilities for p in predictions])[is_scored], labels[is_scored]
    is_correct, is_object = probabilities.argmax(axis=1) == labels, labels < len(config.classes)
    return {
        **metrics,
        "accuracy": 100 * float(is_correct.mean()) if len(is_correct) else math.nan,
        "object_accuracy": 100 * float(is_correct[is_object].mean()) if is_object.any() else math.nan,
        "calibration_error": compute_calibration_error(probabilities, labels),
    }, calibration
