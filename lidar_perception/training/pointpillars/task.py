"""What PointPillars brings to the training loop: its samples, loss, validation and checkpoints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lidar_perception.classes import DONT_CARE
from lidar_perception.data.frame import Frame
from lidar_perception.detectors.checkpoint import Header
from lidar_perception.detectors.contract import Detector
from lidar_perception.detectors.params import ScoreParams
from lidar_perception.detectors.pointpillars.anchors import anchor_classes, make_anchors
from lidar_perception.detectors.pointpillars.config import NetworkConfig
from lidar_perception.detectors.pointpillars.detector import PointPillarsDetector, TorchNetwork
from lidar_perception.detectors.pointpillars.expert import network_input
from lidar_perception.detectors.pointpillars.losses import detection_loss
from lidar_perception.detectors.pointpillars.network import (
    PointPillars,
    channels_last,
    make_network,
)
from lidar_perception.detectors.pointpillars.params import DetectorParams, PointPillarsParams
from lidar_perception.detectors.pointpillars.pillars import make_pillars
from lidar_perception.detectors.pointpillars.targets import (
    BACKGROUND,
    IGNORED,
    SparseTargets,
    Targets,
    anchors_near,
    assign,
    dense,
    nearest_axis_iou,
    sparse,
)
from lidar_perception.detectors.view import visible
from lidar_perception.geometry import within
from lidar_perception.ground.params import SensorPoseParams
from lidar_perception.runs.terminal import track
from lidar_perception.scoring.detections import Detected, detected
from lidar_perception.scoring.kitti.protocol import NEIGHBOURS
from lidar_perception.scoring.kitti.report import DetectionReport
from lidar_perception.training.augment import TrainingScene, augmented, faced, raised
from lidar_perception.training.data import Batches, ReadScenes, loaded
from lidar_perception.training.database import Database, with_objects
from lidar_perception.training.params import AugmentParams, PointPillarsTraining
from lidar_perception.training.putting import inside
from lidar_perception.training.record import begun_with, judged, keeper, name_skipped
from lidar_perception.training.run import Judged, Task
from lidar_perception.types import (
    CLASSES,
    SENSOR_HEIGHT,
    Detections,
    GroundTruth,
    InputError,
    LidarFrame,
)

# Boxes of low score cost precision only where recall has ended; fewer of them are quicker.
VALIDATED = DetectorParams(pointpillars=PointPillarsParams(scores=ScoreParams.all_alike(0.1),
                                                           warm_up=False))
LIKE = {other: name for name, other in NEIGHBOURS.items()}  # Van: Car, Person_sitting: Pedestrian
TOUCHED = 1e-6  # overlap of an anchor that touches
REGION = -2  # label of a box of the class DontCare


@dataclass(frozen=True)
class Sample:
    """One scene for the network: points and cluster_map as in expert.NetworkInput; boxes (M, 7)
    float32, labels (M,) int64 into the config's classes, REGION for a region of which nothing is
    learned; counted (M,) bool: to be found, the others may be found or not; targets: what of
    them is to be found at which anchors, made here as many processes prepare and one trains."""

    points: np.ndarray
    cluster_map: np.ndarray | None
    boxes: np.ndarray
    labels: np.ndarray
    counted: np.ndarray
    targets: SparseTargets


@dataclass(frozen=True)
class Preparation:
    """scene, rng -> Sample: augmented, cropped to what the network sees, with the experts' columns.
    database: file of objects to put in, or None."""

    config: NetworkConfig
    augment: AugmentParams
    min_points: int = 5
    database: Path | None = None

    @cached_property
    def _objects(self) -> Database | None:
        return None if self.database is None else Database.load(self.database)

    @cached_property
    def _anchors(self) -> Tensor:
        return make_anchors(self.config)

    def __getstate__(self) -> dict:
        return {k: v for k, v in self.__dict__.items() if k not in ("_objects", "_anchors")}

    def __call__(self, scene: TrainingScene, rng: np.random.Generator) -> Sample:
        """InputError if the network would see no point."""
        lower = np.array([0, 0, scene.height - SENSOR_HEIGHT])  # than what the network sees
        low, high = np.array(self.config.low) - lower, np.array(self.config.high) - lower
        scene = faced(scene, self.augment, low, high, rng)
        if self._objects is not None and rng.random() < self.augment.crowded:
            scene = with_objects(scene, self._objects, self.augment, low, high, rng)
        scene = augmented(scene, self.augment, rng)
        frame = LidarFrame(np.ascontiguousarray(scene.points[:, :3]), scene.points[:, 3].copy())
        _, seen = visible(frame, self.config, SensorPoseParams(height=scene.height))
        inputs = network_input(seen, self.config)
        if len(inputs.points) < 2:
            raise InputError("a scene has no point where the network looks")
        boxes, labels, counted = self._objects_to_find(raised(scene, lower[2]), seen.xyz)
        targets = _targets(boxes, labels, counted, self._anchors, self.config)
        return Sample(inputs.points, inputs.cluster_map, boxes, labels, counted, sparse(targets))

    def _objects_to_find(self, scene: TrainingScene, xyz: np.ndarray) -> tuple[np.ndarray, ...]:
        low, high = np.array(self.config.low), np.array(self.config.high)
        names = [CLASSES[i] for i in scene.class_ids]
        labels = np.array([self._label(LIKE.get(name, name)) for name in names], np.int64)
        kept = np.flatnonzero(within(scene.boxes, low, high) & (labels != -1))
        counted = [bool(scene.wanted[i]) and names[i] not in LIKE and labels[i] != REGION
                   and len(inside(xyz, scene.boxes[i], 0.0)) >= self.min_points
                   for i in kept]
        return scene.boxes[kept].astype(np.float32), labels[kept], np.array(counted, bool)

    def _label(self, name: str) -> int:
        if name == CLASSES[DONT_CARE]:
            return REGION
        return self.config.classes.index(name) if name in self.config.classes else -1


def narrowed(config: NetworkConfig, ahead: float, aside: float) -> NetworkConfig:
    """The config with a range that ends so far ahead, and behind if it sees what is there, and to
    each side, metres, made longer to whole cells of the coarsest map, and at most as far as before;
    0 leaves it."""
    step = config.cell * np.prod(config.block_strides)

    def whole(length: float) -> float:
        return float(np.ceil(round(length / step, 6)) * step)

    x, y = whole(ahead), whole(aside)
    (back, right, bottom), (front, left, top) = config.low, config.high
    if ahead:
        front = min(front, max(back, 0.0) + x)
        back = max(back, -x) if back < 0 else back
    if aside:
        right, left = max(right, -y), min(left, y)
    return replace(config, low=(back, right, bottom), high=(front, left, top))


def _targets(boxes: np.ndarray, labels: np.ndarray, counted: np.ndarray, anchors: Tensor,
             config: NetworkConfig) -> Targets:
    """The targets of one sample. Anchors on objects that are not counted, and those of any class
    that touch a region, are neither object nor background."""
    boxes_of, kinds, wanted = map(torch.from_numpy, (boxes, labels, counted))
    targets = assign(anchors, config, boxes_of[wanted], kinds[wanted])
    found = targets.labels[0]
    for index, spec in enumerate(config.anchors):
        for others, least in ((boxes_of[~wanted & (kinds == index)], spec.unmatched),
                              (boxes_of[kinds == REGION], TOUCHED)):
            mine = anchors_near(anchors, config, others, index)
            if len(mine):
                near = nearest_axis_iou(anchors[mine], others).max(dim=1).values >= least
                near &= found[mine] == BACKGROUND
                found[mine[near]] = IGNORED
    return targets


def make_loss(config: NetworkConfig, device: torch.device) -> Callable:
    """loss(network, samples) -> total, parts, as the loop wants it."""
    classes = anchor_classes(config, device)

    def loss(network: nn.Module, samples: Sequence[Sample]) -> tuple[Tensor, dict[str, Tensor]]:
        pillars = make_pillars([torch.from_numpy(s.points).to(device) for s in samples], config)
        drawn = [s.cluster_map for s in samples if s.cluster_map is not None]
        maps = torch.from_numpy(np.stack(drawn)).to(device) if drawn else None
        targets = dense([sample.targets for sample in samples], len(classes), device)
        losses = detection_loss(network(pillars, maps), targets, classes)
        return losses.total, {"classes": losses.classes.detach(), "boxes": losses.boxes.detach(),
                              "directions": losses.directions.detach()}

    return loss


def frame_to_validate(config: NetworkConfig, source: Any, i: int) -> Frame:
    """Frame i of a source, read. Where no camera says what is labelled, with the labels that a
    network of the config is taught: those whose centre it sees. InputError naming the file that
    cannot be used."""
    frame = source.frame(i)
    truth, calibration = frame.truth(), frame.calibration()
    if calibration is None and truth is not None:
        seen = np.flatnonzero(within(truth.boxes, config.low, config.high))
        truth = GroundTruth.of(truth.boxes[seen], truth.class_ids[seen],
                               [truth.extras[k] for k in seen], truth.notes)
    return Frame.of(frame.name, frame.load(), truth, calibration,
                    sensor_height=frame.sensor_height)


def validation_report(detector: Detector, scenes: ReadScenes, jobs: int = 0) -> DetectionReport:
    """The detector on every scene, by KITTI's protocol."""
    report = DetectionReport()
    items = loaded(scenes, ([n] for n in range(len(scenes))), jobs)
    for item, in track(items, "validating", len(scenes)):
        report.skipped += item.skipped
        if item.sample is not None:
            report.update(found_in(item.sample, detector))
    return report


def found_in(frame: Frame, detector: Detector) -> Detected[Detections]:
    """What a detector says of a frame that is read, as from the height of its sensor."""
    height = frame.sensor_height
    at = detector if height == SENSOR_HEIGHT else detector.mounted_at(height)
    return detected(at, frame, frame.truth(), frame.calibration())


def make_task(config: NetworkConfig, params: PointPillarsTraining, batches: Batches,
              validation: ReadScenes, out: Path, device: torch.device, about: dict[str, Any],
              commit: str = "", init: Path | None = None) -> Task[PointPillars]:
    """The task of training a network of a config. about: what the header says of the data; a
    resumed run must have the same. init: checkpoint to begin with, see checkpoint.adopt. Weights
    are written to out/best.safetensors and out/last.safetensors."""
    torch.manual_seed(params.seed)
    network = begun_with(make_network(config), init, NetworkConfig)
    network = channels_last(network.to(device))
    named: set[str] = set()

    def validate(module: PointPillars) -> Judged:
        detector = PointPillarsDetector(TorchNetwork(module, device), Header(config), device,
                                        VALIDATED)
        report = validation_report(detector, validation, batches.jobs)
        name_skipped(report.skipped, len(report.frames), named)
        return judged(report, params.score, config.classes)

    seen = narrowed(config, params.ahead, params.aside)
    return Task(network, make_loss(seen, device), batches, validate,
                keeper(out, config, params, batches, about, commit), batches.epoch, about)
