"""What the cluster network brings to the training loop: samples, loss, validation, checkpoints."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lidar_perception.camera import Calibration
from lidar_perception.detectors.params import MIN_SCORE
from lidar_perception.detectors.pointnet.box_head import BoxTargets, cluster_loss, encode
from lidar_perception.detectors.pointnet.calibration import calibrate, calibration_error
from lidar_perception.detectors.pointnet.clusters import (
    ClusterInput,
    Clusters,
    middles,
    network_input,
)
from lidar_perception.detectors.pointnet.config import PointNetConfig
from lidar_perception.detectors.pointnet.network import PointNet, make_pointnet
from lidar_perception.detectors.pointnet.predict import found, outputs_of, predict
from lidar_perception.detectors.view import as_found
from lidar_perception.geometry import points_in_box
from lidar_perception.ground.params import SensorPoseParams
from lidar_perception.runs.terminal import track
from lidar_perception.scoring.detections import Detected
from lidar_perception.scoring.kitti.report import DetectionReport
from lidar_perception.training.augment import noisy, varied
from lidar_perception.training.data import Batches, ReadScenes, loaded
from lidar_perception.training.params import ClusterAugmentParams, PointNetTraining
from lidar_perception.training.pointnet.cut_scenes import FEWEST, CutScene, CutScenes
from lidar_perception.training.record import begun_with, judged, keeper, name_skipped
from lidar_perception.training.run import Judged, Task
from lidar_perception.types import SENSOR_HEIGHT, GroundTruth, InputError

SCORED_POINTS = 10  # clusters with fewer do not count in the accuracy


@dataclass(frozen=True)
class ClusterSample:
    """Clusters for the network with what it shall say: labels (K,) int64, has_box (K,) bool."""

    inputs: ClusterInput
    labels: np.ndarray
    targets: BoxTargets[np.ndarray]
    has_box: np.ndarray


@dataclass(frozen=True)
class ClusterPreparation:
    """scene, rng -> ClusterSample: some of its clusters, changed in ways that a network should not
    mind."""

    config: PointNetConfig
    augment: ClusterAugmentParams
    judge: bool = False  # half of the background is decoys, as far as there are any

    def __call__(self, scene: CutScene, rng: np.random.Generator) -> ClusterSample:
        """InputError if it has no cluster to learn from."""
        chosen = self._chosen(scene, rng)
        if len(chosen) == 0:
            raise InputError("a scene has no cluster to learn from")
        labels, boxes = scene.labels[chosen], scene.boxes[chosen].copy()
        clusters = scene.clusters.take(chosen)
        background = np.flatnonzero(labels == len(self.config.classes))
        feet = np.column_stack([middles(clusters.points, clusters.first), clusters.floor])
        for k in background:
            own = slice(clusters.first[k], clusters.first[k + 1])
            clusters.points[own], _ = varied(clusters.points[own], feet[k], self.augment, rng)
        clusters, boxes = changed(clusters, boxes, scene.loose[chosen], self.augment, rng)
        inputs = network_input(clusters, self.config.points, int(rng.integers(1 << 30)))
        has_box = (labels >= 0) & (labels < len(self.config.classes))
        classes = np.where(has_box, labels, 0)
        targets = encode(boxes, classes, inputs.centres, inputs.azimuths, self.config)
        return ClusterSample(inputs, labels, targets, has_box)

    def _chosen(self, scene: CutScene, rng: np.random.Generator) -> np.ndarray:
        """All objects, up to a number of each class, and some background."""
        chosen = []
        for label in range(len(self.config.classes) + 1):
            most = (self.augment.background if label == len(self.config.classes)
                    else self.augment.objects)
            known = rng.permutation(np.flatnonzero(scene.labels == label))
            if self.judge and label == len(self.config.classes):
                decoys = known[scene.loose[known]][:most // 2]
                known = np.concatenate([decoys, known[~scene.loose[known]]])
            chosen.append(known[:most])
        return np.sort(np.concatenate(chosen))


def changed(clusters: Clusters, boxes: np.ndarray, loose: np.ndarray,
            params: ClusterAugmentParams, rng: np.random.Generator
            ) -> tuple[Clusters, np.ndarray]:
    """Clusters and their boxes (K, 7), all flipped and scaled in the same way, each moved
    away with fewer points as a sensor would see it, thinned and made noisy by itself; loose ones
    (K,) cut at a box that is a little off."""
    count = len(clusters)
    number = np.repeat(np.arange(count), clusters.sizes)
    points, boxes = clusters.points.copy(), boxes.copy()
    keep = np.ones(len(points), bool)
    for k in np.flatnonzero(loose):
        part = slice(clusters.first[k], clusters.first[k + 1])
        off = boxes[k] + rng.normal(0, params.box_shift, 7) * [1, 1, 0.5, 0, 0, 0, 0.3]
        off[3:6] *= rng.uniform(0.9, 1.15, 3)
        keep[part] = points_in_box(points[part, :3], off)
    farther = np.where(rng.random(count) < 0.3, rng.uniform(1, 1 + params.farther, count), 1.0)
    share = np.where(rng.random(count) < 0.5, rng.uniform(1 - params.dropout, 1, count), 1.0)
    keep &= rng.random(len(points)) < (share / farther**2)[number]
    left = np.bincount(number[keep], minlength=count)
    keep |= (left < FEWEST)[number]
    farther = np.where(left < FEWEST, 1.0, farther)
    middles = _means(points[:, :2].astype(np.float64), number, count)
    ways = middles * (farther - 1)[:, None]
    points[:, :2] += ways[number].astype(np.float32)
    boxes[:, :2] += ways
    scale = 1 + rng.uniform(-params.scale, params.scale)
    height = rng.uniform(-params.height, params.height)
    floor = clusters.floor
    points[:, 2] -= floor[number].astype(np.float32)
    boxes[:, 2] -= floor
    points[:, :3] *= np.float32(scale)
    boxes[:, :6] *= scale
    points[:, 2] += floor[number].astype(np.float32)
    boxes[:, 2] += floor
    # The ground is known to so much only.
    floor = floor + height + rng.uniform(-0.5, 0.5, count) * params.height
    if rng.random() < params.flip:
        points[:, 1] *= -1
        boxes[:, [1, 6]] *= -1
    points = noisy(points, params, rng)
    gain = rng.uniform(1 - params.intensity, 1 + params.intensity)
    points[:, 3] = np.clip(points[:, 3] * gain, 0, 1)
    sizes = np.bincount(number[keep], minlength=count)
    first = np.concatenate([[0], np.cumsum(sizes)])
    return Clusters(points[keep], first, clusters.ids, floor), boxes


def _means(values: np.ndarray, number: np.ndarray, count: int) -> np.ndarray:
    """(count, D) means of values (P, D) by number (P,); 0 where there are none."""
    sums = np.stack([np.bincount(number, column, minlength=count) for column in values.T], axis=1)
    return sums / np.maximum(np.bincount(number, minlength=count), 1)[:, None]


def make_loss(config: PointNetConfig, device: torch.device) -> Callable:
    """loss(network, samples) -> total, parts, as the loop wants it."""
    def tensor(arrays: Sequence[np.ndarray]) -> Tensor:
        return torch.from_numpy(np.concatenate(arrays)).to(device)

    def loss(network: nn.Module, samples: Sequence[ClusterSample]
             ) -> tuple[Tensor, dict[str, Tensor]]:
        inputs = [s.inputs for s in samples]
        outputs = network(tensor([i.points for i in inputs]), tensor([i.valid for i in inputs]),
                          tensor([i.context for i in inputs]))
        targets = BoxTargets(*(tensor(parts) for parts in zip(*(s.targets for s in samples))))
        losses = cluster_loss(outputs, tensor([s.labels for s in samples]), targets,
                              tensor([s.has_box for s in samples]))
        return losses.total, {"classes": losses.classes.detach(), "boxes": losses.boxes.detach(),
                              "yaw_bins": losses.yaw_bins.detach()}

    return loss


@dataclass(frozen=True)
class ValidationClusters:
    """A scene to validate on: the clusters that clustering made, with the truth of its frame.
    height: of its sensor, metres."""

    name: str
    clusters: Clusters
    labels: np.ndarray
    truth: GroundTruth | None
    calibration: Calibration | None
    height: float = SENSOR_HEIGHT


def clusters_to_validate(source: CutScenes, i: int) -> ValidationClusters:
    """Scene i of a source, to validate on. InputError naming the file that cannot be used."""
    scene = source.scene(i)
    made = np.flatnonzero(~scene.loose)
    frame = source.frame(i)
    return ValidationClusters(frame.name, scene.clusters.take(made), scene.labels[made],
                              frame.truth(), frame.calibration(), frame.sensor_height)


def validated(network: PointNet, scenes: Sequence[ValidationClusters]) -> Judged:
    """Calibrate the network on the scenes, one at least, and score it, see Task: score, the mean AP
    from above at the relaxed overlaps (moderate, R40), and each class's; accuracy, the share of
    clusters of SCORED_POINTS or more, and of the objects among them, whose class is right, NaN
    without any. Scenes may have no cluster."""
    config = network.config
    labels = np.concatenate([s.labels for s in scenes])
    sizes = np.concatenate([s.clusters.sizes for s in scenes])
    if len(labels):
        logits = torch.cat([
            outputs_of(network, network_input(s.clusters, config.points)).logits.cpu()
            for s in scenes if len(s.clusters)])
        calibrate(network, logits, torch.from_numpy(labels))
    report, predictions = DetectionReport(), []
    for scene in track(scenes, "validating", len(scenes)):
        predictions.append(predict(network, scene.clusters))
        boxes = found(predictions[-1], config, [MIN_SCORE] * len(config.classes))
        boxes = as_found(boxes, SensorPoseParams(height=scene.height))
        report.update(Detected(scene.name, scene.truth, boxes, scene.calibration))
    metrics, calibration = judged(report, "bev", config.classes)
    known = (labels >= 0) & (sizes >= SCORED_POINTS)
    probabilities = np.concatenate([p.probabilities for p in predictions])[known]
    right, objects = probabilities.argmax(axis=1) == labels[known], labels[known] < len(
        config.classes)
    return {**metrics, "accuracy": 100 * float(right.mean()) if len(right) else math.nan,
            "object_accuracy": 100 * float(right[objects].mean()) if objects.any() else math.nan,
            "calibration_error": calibration_error(probabilities, labels[known])}, calibration


def make_task(config: PointNetConfig, params: PointNetTraining, batches: Batches,
              validation: ReadScenes, out: Path, device: torch.device, about: dict[str, Any],
              commit: str = "", init: Path | None = None) -> Task[PointNet]:
    """The task of training a network of a config; see training.pointpillars.make_task."""
    torch.manual_seed(params.seed)
    network = begun_with(make_pointnet(config), init, PointNetConfig).to(device)
    scenes: list[ValidationClusters] = []

    def validate(module: PointNet) -> Judged:
        if not scenes:
            items = [item for item, in loaded(validation, ([n] for n in range(len(validation))),
                                              batches.jobs)]
            scenes.extend(item.sample for item in items if item.sample is not None)
            name_skipped([reason for item in items for reason in item.skipped], len(scenes), set())
        return validated(module, scenes)

    return Task(network, make_loss(config, device), batches, validate,
                keeper(out, config, params, batches, about, commit), batches.epoch, about)
