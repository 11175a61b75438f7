"""Training task of PointPillars: samples, loss and validation."""

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
from lidar_perception.detectors.contract import Detector
from lidar_perception.detectors.normalized_view import NormalizedView
from lidar_perception.detectors.params import ScoreParams
from lidar_perception.detectors.pointpillars.anchors import get_anchor_classes, make_anchors
from lidar_perception.detectors.pointpillars.config import NetworkConfig
from lidar_perception.detectors.pointpillars.expert import make_network_input
from lidar_perception.detectors.pointpillars.losses import compute_detection_loss
from lidar_perception.detectors.pointpillars.params import DetectorParams, PointPillarsParams
from lidar_perception.detectors.pointpillars.pillar_batch import make_pillar_batch
from lidar_perception.detectors.pointpillars.targets import (
    BACKGROUND,
    IGNORED,
    SparseTargets,
    Targets,
    assign_targets,
    find_near_anchors,
    nearest_axis_iou,
    to_dense,
    to_sparse,
)
from lidar_perception.geometry import is_within
from lidar_perception.ground.params import SensorPoseParams
from lidar_perception.runs.terminal import show_progress
from lidar_perception.scoring.detections import FrameDetections, run_detector
from lidar_perception.scoring.kitti.protocol import NEIGHBOURS
from lidar_perception.scoring.kitti.report import DetectionReport
from lidar_perception.training.augment import TrainingScene, augment_scene, raise_scene, rotate_and_crop
from lidar_perception.training.data import SceneReader, load_items
from lidar_perception.training.database import Database, paste_objects
from lidar_perception.training.params import AugmentParams
from lidar_perception.training.pasting import find_points_in_box
from lidar_perception.types import CLASSES, SENSOR_HEIGHT, Detections, InputError, PointCloud

# Boxes with low scores are omitted: they hardly change the AP, but take time.
VALIDATION_PARAMS = DetectorParams(
    pointpillars=PointPillarsParams(scores=ScoreParams.for_all_classes(0.1), warm_up=False)
)
CLASS_BY_SIMILAR = {other: name for name, other in NEIGHBOURS.items()}  # {"Van": "Car", ...}
MIN_TOUCH_IOU = 1e-6  # minimum IoU of an anchor that touches a box
DONT_CARE_LABEL = -2  # label of a box of the class DontCare


@dataclass(frozen=True)
class Sample:
    """Training sample of one scene.

    Attributes:
        points, cluster_map: See expert.NetworkInput.
        boxes: (M, 7) float32.
        labels: (M,) int64 into the config's classes; DONT_CARE_LABEL for a region without labels.
        is_target: (M,) bool, True for objects that must be detected; other objects are ignored.
        targets: Targets of the anchors.
    """

    points: np.ndarray
    cluster_map: np.ndarray | None
    boxes: np.ndarray
    labels: np.ndarray
    is_target: np.ndarray
    targets: SparseTargets


@dataclass(frozen=True)
class ScenePreparation:
    """Function (scene, rng) that augments and crops a scene and adds the expert columns to make a Sample.

    Attributes:
        config: Configuration of the network.
        augment: Limits of the augmentation.
        min_points: Objects with fewer points are ignored.
        database: File of objects to paste, or None.
    """

    config: NetworkConfig
    augment: AugmentParams
    min_points: int = 5
    database: Path | None = None

    @cached_property
    def _objects(self) -> Database | None:
        return None if self.database is None else Database.load(self.database)

    @cached_property
    def _anchors(self) -> Tensor:
        return torch.from_numpy(make_anchors(self.config))

    def __getstate__(self) -> dict:
        return {k: v for k, v in self.__dict__.items() if k not in ("_objects", "_anchors")}

    def __call__(self, scene: TrainingScene, rng: np.random.Generator) -> Sample:
        """Make the sample of a scene. Raise InputError if no point is in the detection range."""
        shift = np.array([0, 0, scene.height - SENSOR_HEIGHT])  # to the frame of a sensor at SENSOR_HEIGHT
        low, high = np.array(self.config.low) - shift, np.array(self.config.high) - shift
        scene = rotate_and_crop(scene, self.augment, low, high, rng)
        if self._objects is not None and rng.random() < self.augment.crowded:
            scene = paste_objects(scene, self._objects, self.augment, low, high, rng)
        scene = augment_scene(scene, self.augment, rng)
        frame = PointCloud(np.ascontiguousarray(scene.points[:, :3]), scene.points[:, 3].copy())
        pose = SensorPoseParams(height=scene.height)
        view = NormalizedView.of(frame, pose, self.config.low, self.config.high).frame
        inputs = make_network_input(view, self.config)
        if len(inputs.points) < 2:
            raise InputError("a scene has no point in the detection range")
        boxes, labels, is_target = self._select_objects(raise_scene(scene, shift[2]), view.xyz)
        targets = _assign_targets(boxes, labels, is_target, self._anchors, self.config)
        return Sample(inputs.points, inputs.cluster_map, boxes, labels, is_target, to_sparse(targets))

    def _select_objects(self, scene: TrainingScene, xyz: np.ndarray) -> tuple[np.ndarray, ...]:
        low, high = np.array(self.config.low), np.array(self.config.high)
        names = [CLASSES[i] for i in scene.class_ids]
        labels = np.array([self._find_label(CLASS_BY_SIMILAR.get(name, name)) for name in names], np.int64)
        indices = np.flatnonzero(is_within(scene.boxes, low, high) & (labels != -1))
        is_target = [
            bool(scene.detectable[i])
            and names[i] not in CLASS_BY_SIMILAR
            and labels[i] != DONT_CARE_LABEL
            and len(find_points_in_box(xyz, scene.boxes[i], 0.0)) >= self.min_points
            for i in indices
        ]
        return scene.boxes[indices].astype(np.float32), labels[indices], np.array(is_target, bool)

    def _find_label(self, name: str) -> int:
        if name == CLASSES[DONT_CARE]:
            return DONT_CARE_LABEL
        return self.config.classes.index(name) if name in self.config.classes else -1


def reduce_range(config: NetworkConfig, ahead: float, aside: float) -> NetworkConfig:
    """Return the config with a shorter detection range, rounded up to full cells of the feature map.

    Args:
        config: Configuration of the network.
        ahead: Range ahead, and behind if the config covers it, in metres; 0 does not change it.
        aside: Range to each side in metres; 0 does not change it.
    """
    step = config.cell * np.prod(config.block_strides)
    x, y = (float(np.ceil(round(length / step, 6)) * step) for length in (ahead, aside))
    (back, right, bottom), (front, left, top) = config.low, config.high
    if ahead:
        front = min(front, max(back, 0.0) + x)
        back = max(back, -x) if back < 0 else back
    if aside:
        right, left = max(right, -y), min(left, y)
    return replace(config, low=(back, right, bottom), high=(front, left, top))


def _assign_targets(
    boxes: np.ndarray, labels: np.ndarray, is_target: np.ndarray, anchors: Tensor, config: NetworkConfig
) -> Targets:
    """Assign the anchors to the objects of one sample.

    Anchors on other objects, and anchors that touch a DontCare region, are ignored.
    """
    all_boxes, classes, target_mask = map(torch.from_numpy, (boxes, labels, is_target))
    targets = assign_targets(anchors, config, all_boxes[target_mask], classes[target_mask])
    anchor_labels = targets.labels[0]
    for index, spec in enumerate(config.anchors):
        for ignored_boxes, min_iou in (
            (all_boxes[~target_mask & (classes == index)], spec.unmatched),
            (all_boxes[classes == DONT_CARE_LABEL], MIN_TOUCH_IOU),
        ):
            candidates = find_near_anchors(anchors, config, ignored_boxes, index)
            if len(candidates):
                is_ignored = nearest_axis_iou(anchors[candidates], ignored_boxes).max(dim=1).values >= min_iou
                is_ignored &= anchor_labels[candidates] == BACKGROUND
                anchor_labels[candidates[is_ignored]] = IGNORED
    return targets


def make_loss(config: NetworkConfig, device: torch.device) -> Callable:
    """Return loss(network, samples) -> (total, parts), see Task."""
    classes = torch.from_numpy(get_anchor_classes(config)).to(device)

    def loss(network: nn.Module, samples: Sequence[Sample]) -> tuple[Tensor, dict[str, Tensor]]:
        pillars = make_pillar_batch([torch.from_numpy(s.points).to(device) for s in samples], config)
        cluster_maps = [s.cluster_map for s in samples if s.cluster_map is not None]
        maps = torch.from_numpy(np.stack(cluster_maps)).to(device) if cluster_maps else None
        targets = to_dense([sample.targets for sample in samples], len(classes), device)
        losses = compute_detection_loss(network(pillars, maps), targets, classes)
        return losses.total, {
            "classes": losses.classes.detach(),
            "boxes": losses.boxes.detach(),
            "directions": losses.directions.detach(),
        }

    return loss


def load_validation_frame(config: NetworkConfig, source: Any, i: int) -> Frame:
    """Load frame i of a source.

    Without a camera, labels whose centre is outside the detection range are removed.

    Raises:
        InputError: The frame cannot be read.
    """
    frame = source.load_frame(i)
    truth, calibration = frame.truth(), frame.calibration()
    if calibration is None and truth is not None:
        truth = truth.take(is_within(truth.boxes, config.low, config.high))
    return Frame.of(frame.name, frame.load(), truth, calibration, sensor_height=frame.sensor_height)


def validate_detector(detector: Detector, scenes: SceneReader, jobs: int = 0) -> DetectionReport:
    """Evaluate a detector on all validation scenes by KITTI's protocol."""
    report = DetectionReport()
    items = load_items(scenes, ([n] for n in range(len(scenes))), jobs)
    for (item,) in show_progress(items, "validating", len(scenes)):
        report.skipped += item.skipped
        if item.sample is not None:
            report.update(detect_in_frame(item.sample, detector))
    return report


def detect_in_frame(frame: Frame, detector: Detector) -> FrameDetections[Detections]:
    """Run a detector on a loaded frame, with the frame's sensor height."""
    height = frame.sensor_height
    if height != SENSOR_HEIGHT:
        detector = detector.with_sensor_height(height)
    return run_detector(detector, frame, frame.truth(), frame.calibration())
