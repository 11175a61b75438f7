"""The training task of the PointNet: samples, loss and validation."""

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
from lidar_perception.detectors.pointnet.calibration import calibrate, calibration_error
from lidar_perception.detectors.pointnet.clusters import ClusterInput, Clusters, compute_centroids, make_network_input
from lidar_perception.detectors.pointnet.config import PointNetConfig
from lidar_perception.detectors.pointnet.losses import cluster_loss
from lidar_perception.detectors.pointnet.network import PointNet
from lidar_perception.detectors.pointnet.predict import predict, select_detections
from lidar_perception.detectors.pointnet.torch_network import TorchPointNet, run_network
from lidar_perception.geometry import points_in_box
from lidar_perception.ground.params import SensorPoseParams
from lidar_perception.runs.terminal import show_progress
from lidar_perception.scoring.detections import FrameDetections
from lidar_perception.scoring.kitti.report import DetectionReport
from lidar_perception.training.augment import add_range_noise, distort_intensity, vary_thing
from lidar_perception.training.params import ClusterAugmentParams
from lidar_perception.training.pointnet.cut_scenes import MIN_POINTS_LEFT, CutScene, CutScenes
from lidar_perception.training.record import summarize_report
from lidar_perception.training.run import Validation
from lidar_perception.types import SENSOR_HEIGHT, GroundTruth, InputError

MIN_SCORED_POINTS = 10  # minimum points of a cluster that counts in the accuracy


@dataclass(frozen=True)
class ClusterSample:
    """K clusters with their targets.

    Attributes:
        inputs: Input of the network.
        labels: (K,) int64 classes.
        targets: Encoded boxes.
        has_box: (K,) bool, the box target counts.
    """

    inputs: ClusterInput
    labels: np.ndarray
    targets: BoxTargets[np.ndarray]
    has_box: np.ndarray


@dataclass(frozen=True)
class ClusterPreparation:
    """Preparation of a ClusterSample: some clusters of a scene are drawn and augmented.

    Attributes:
        augment: Numbers of clusters, and limits of the changes.
        with_decoys: Half of the background consists of decoys, if there are enough.
    """

    config: PointNetConfig
    augment: ClusterAugmentParams
    with_decoys: bool = False

    def __call__(self, scene: CutScene, rng: np.random.Generator) -> ClusterSample:
        """Prepare a scene. Raise InputError if it has no cluster to learn from."""
        chosen = self._draw_clusters(scene, rng)
        if len(chosen) == 0:
            raise InputError("a scene has no cluster to learn from")
        labels, boxes = scene.labels[chosen], scene.boxes[chosen].copy()
        clusters = scene.clusters.take(chosen)
        background = np.flatnonzero(labels == len(self.config.classes))
        feet = np.column_stack([compute_centroids(clusters.points, clusters.first), clusters.floor])
        for k in background:
            own = slice(clusters.first[k], clusters.first[k + 1])
            clusters.points[own], _ = vary_thing(clusters.points[own], feet[k], self.augment, rng)
        clusters, boxes = augment_clusters(clusters, boxes, scene.loose[chosen], self.augment, rng)
        inputs = make_network_input(clusters, self.config.points, int(rng.integers(1 << 30)), self.config.farthest)
        has_box = (labels >= 0) & (labels < len(self.config.classes))
        classes = np.where(has_box, labels, 0)
        targets = encode(boxes, classes, inputs.centres, inputs.azimuths, self.config)
        return ClusterSample(inputs, labels, targets, has_box)

    def _draw_clusters(self, scene: CutScene, rng: np.random.Generator) -> np.ndarray:
        """Draw objects up to a number of each class, and some background."""
        chosen = []
        for label in range(len(self.config.classes) + 1):
            limit = self.augment.background if label == len(self.config.classes) else self.augment.objects
            own = rng.permutation(np.flatnonzero(scene.labels == label))
            if self.with_decoys and label == len(self.config.classes):
                decoys = own[scene.loose[own]][: limit // 2]
                own = np.concatenate([decoys, own[~scene.loose[own]]])
            chosen.append(own[:limit])
        return np.sort(np.concatenate(chosen))


def augment_clusters(
    clusters: Clusters, boxes: np.ndarray, loose: np.ndarray, params: ClusterAugmentParams, rng: np.random.Generator
) -> tuple[Clusters, np.ndarray]:
    """Change clusters at random.

    All are flipped and scaled in the same way. Each loses points, gets noise, and may be moved away
    with as many points as the sensor would see there. Loose clusters are cut at a shifted box.

    Args:
        boxes: (K, 7) boxes.
        loose: (K,) bool, see CutScene.

    Returns:
        The changed clusters and boxes.
    """
    count = len(clusters)
    number = np.repeat(np.arange(count), clusters.sizes)
    points, boxes = clusters.points.copy(), boxes.copy()
    keep = np.ones(len(points), bool)
    for k in np.flatnonzero(loose):
        part = slice(clusters.first[k], clusters.first[k + 1])
        shifted = boxes[k] + rng.normal(0, params.box_shift, 7) * [1, 1, 0.5, 0, 0, 0, 0.3]
        shifted[3:6] *= rng.uniform(0.9, 1.15, 3)
        keep[part] = points_in_box(points[part, :3], shifted)
    farther = np.where(rng.random(count) < 0.3, rng.uniform(1, 1 + params.farther, count), 1.0)
    share = np.where(rng.random(count) < 0.5, rng.uniform(1 - params.dropout, 1, count), 1.0)
    keep &= rng.random(len(points)) < (share / farther**2)[number]
    left = np.bincount(number[keep], minlength=count)
    keep |= (left < MIN_POINTS_LEFT)[number]
    farther = np.where(left < MIN_POINTS_LEFT, 1.0, farther)
    centres = _group_means(points[:, :2].astype(np.float64), number, count)
    shifts = centres * (farther - 1)[:, None]
    points[:, :2] += shifts[number].astype(np.float32)
    boxes[:, :2] += shifts
    scale = 1 + rng.uniform(-params.scale, params.scale)
    height = rng.uniform(-params.height, params.height)
    floor = clusters.floor
    points[:, 2] -= floor[number].astype(np.float32)
    boxes[:, 2] -= floor
    points[:, :3] *= np.float32(scale)
    boxes[:, :6] *= scale
    points[:, 2] += floor[number].astype(np.float32)
    boxes[:, 2] += floor
    # Random vertical shift, because the ground height is uncertain.
    floor = floor + height + rng.uniform(-0.5, 0.5, count) * params.height
    if rng.random() < params.flip:
        points[:, 1] *= -1
        boxes[:, [1, 6]] *= -1
    points = add_range_noise(points, params, rng)
    gain = rng.uniform(1 - params.intensity, 1 + params.intensity)
    points[:, 3] = np.clip(points[:, 3] * gain, 0, 1)
    points = distort_intensity(points, params, rng)
    sizes = np.bincount(number[keep], minlength=count)
    first = np.concatenate([[0], np.cumsum(sizes)])
    return Clusters(points[keep], first, clusters.ids, floor), boxes


def _group_means(values: np.ndarray, number: np.ndarray, count: int) -> np.ndarray:
    """Return the means (count, D) of values (P, D) by group number (P,), 0 for empty groups."""
    sums = np.stack([np.bincount(number, column, minlength=count) for column in values.T], axis=1)
    return sums / np.maximum(np.bincount(number, minlength=count), 1)[:, None]


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
        losses = cluster_loss(
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
    """A scene to validate on: the clusters that clustering made, and the truth of the frame.

    labels: (K,) int64; height: height of the sensor in metres.
    """

    name: str
    clusters: Clusters
    labels: np.ndarray
    truth: GroundTruth | None
    calibration: Calibration | None
    height: float = SENSOR_HEIGHT


def load_validation_clusters(source: CutScenes, i: int) -> ValidationClusters:
    """Return scene i of a source. Raise InputError, naming the file, if it cannot be used."""
    scene = source.scene(i)
    made = np.flatnonzero(~scene.loose)
    frame = source.frame(i)
    return ValidationClusters(
        frame.name,
        scene.clusters.take(made),
        scene.labels[made],
        frame.truth(),
        frame.calibration(),
        frame.sensor_height,
    )


def validate_network(network: PointNet, scenes: Sequence[ValidationClusters]) -> Validation:
    """Calibrate the network on one or more scenes, and score it.

    Returns:
        Metrics and calibration, see Task.validate. The score is the mean BEV AP at the relaxed
        overlaps (moderate, R40). The accuracies are shares of clusters with at least
        MIN_SCORED_POINTS points, and of the objects among them, whose class is correct; NaN
        without any.
    """
    config = network.config
    labels = np.concatenate([s.labels for s in scenes])
    sizes = np.concatenate([s.clusters.sizes for s in scenes])
    if len(labels):
        logits = torch.cat(
            [
                run_network(
                    network, make_network_input(s.clusters, config.points, farthest=config.farthest)
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
    known = (labels >= 0) & (sizes >= MIN_SCORED_POINTS)
    probabilities = np.concatenate([p.probabilities for p in predictions])[known]
    right, objects = probabilities.argmax(axis=1) == labels[known], labels[known] < len(config.classes)
    return {
        **metrics,
        "accuracy": 100 * float(right.mean()) if len(right) else math.nan,
        "object_accuracy": 100 * float(right[objects].mean()) if objects.any() else math.nan,
        "calibration_error": calibration_error(probabilities, labels[known]),
    }, calibration
