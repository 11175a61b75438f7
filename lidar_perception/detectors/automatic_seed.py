"""Automatic seed of paper A's pipeline: the clusters that PointNet classifies as pedestrians."""

from __future__ import annotations

import functools

import numpy as np

from lidar_perception.candidates.params import SeedParams
from lidar_perception.candidates.seed_sources import SeedSource
from lidar_perception.candidates.seeds import MIN_POINTS, Seed, seed_from_points
from lidar_perception.candidates.segmented_cloud import SegmentedCloud, is_person_sized
from lidar_perception.detectors.normalized_view import NormalizedView
from lidar_perception.detectors.pointnet.classifier import PointNetClassifier
from lidar_perception.detectors.pointnet.detector import load_pointnet_detector
from lidar_perception.detectors.pointnet.params import PointNetDetectorParams, PointNetParams
from lidar_perception.detectors.weights_file import find_classifier_weights
from lidar_perception.ground.surface import fit_ground_surface
from lidar_perception.types import PEDESTRIAN, SENSOR_HEIGHT, Detections, PointCloud

MAX_SEEDS = 8
MAX_GROUND_DISTANCE_M = 100.0  # maximum |x| and |y| of the ground points that are used


def make_automatic_source(params: SeedParams = SeedParams()) -> SeedSource:
    """Make a source whose seeds are the clusters that are most probably pedestrians.

    It returns up to MAX_SEEDS seeds, each with a probability of at least `params.min_confidence`.
    """

    def source(segmented: SegmentedCloud) -> tuple[Seed, ...]:
        probabilities = classify_pedestrians(segmented)
        best_indices = np.argsort(-probabilities, kind="stable")[:MAX_SEEDS]
        return tuple(
            seed_from_points(segmented.xyz[segmented.cluster_ids == i + 1], segmented.boxes[i], float(probabilities[i]))
            for i in best_indices
            if probabilities[i] >= params.min_confidence
        )

    return source


def classify_pedestrians(segmented: SegmentedCloud) -> np.ndarray:
    """Return the probability (K,) float64 that each cluster of a segmented cloud is a pedestrian.

    The PointNet of the fused detector classifies them. The probability is -1 for clusters that are
    too large or too small for a person, or have too few points for a seed.
    """
    is_near = (np.abs(segmented.xyz[:, :2]) <= MAX_GROUND_DISTANCE_M).all(axis=1) & np.isfinite(segmented.xyz[:, 2])
    is_near_ground = segmented.ground & is_near
    surface = fit_ground_surface(segmented.xyz.compress(is_near_ground, axis=0), -SENSOR_HEIGHT)
    view = NormalizedView.of(PointCloud(segmented.xyz, segmented.intensity)).flatten(surface)
    sizes = np.bincount(segmented.cluster_ids, minlength=len(segmented.boxes) + 1)[1:]
    indices = np.flatnonzero(is_person_sized(segmented.boxes) & (sizes >= MIN_POINTS))
    boxes = segmented.boxes[indices]
    boxes[:, 2] -= surface.height_at(boxes) + SENSOR_HEIGHT
    probabilities = np.full(len(segmented.boxes), -1.0)
    probabilities[indices], _ = _load_classifier().classify(
        Detections.of(boxes, PEDESTRIAN, np.ones(len(boxes))),
        view.frame.take(np.flatnonzero(~segmented.ground)),
        view.frame.xyz.compress(is_near_ground, axis=0),
        np.ones(len(boxes), bool),
    )
    return probabilities


def warm_up_automatic_seed() -> None:
    """Load the network, and compile its code on synthetic points."""
    box = np.array([[8, 0, -0.8, 1, 1, 1.7, 0]], np.float32)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (400, 3)).astype(np.float32) + box[0, :3]
    classify_pedestrians(SegmentedCloud(np.arange(400), points, np.arange(400) < 100, np.ones(400, np.int32), box))


@functools.cache
def _load_classifier() -> PointNetClassifier:
    params = PointNetDetectorParams(pointnet=PointNetParams(warm_up=False))
    return load_pointnet_detector(find_classifier_weights(), "cpu", params).classifier
