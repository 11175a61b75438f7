"""Selection of pedestrian candidates among clusters: height filter, STM and CPA (paper A)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np

from lidar_perception.candidates.confidence import compute_confidence, compute_shape_features
from lidar_perception.candidates.params import HeightParams, PipelineParams
from lidar_perception.candidates.seeds import Seed, find_seed_cluster
from lidar_perception.candidates.silhouette import compute_cpa_scales, compute_similarity, draw_silhouettes
from lidar_perception.groups import group_points
from lidar_perception.types import PEDESTRIAN, Detections

STAGES = ("stage1", "stage2", "final")


@dataclass(frozen=True)
class Candidates:
    """Detections after each stage of the refinement.

    Scores are the similarity to the seed (without CPA for stage1 and stage2) or, if enabled, the
    confidence.

    Attributes:
        stage1: Detections after the height filter.
        stage2: Detections after STM.
        final: Detections after STM with CPA.
        clusters: (K,) int64 cluster ids of the detections in `final`, ascending.
        ms: Duration of each step in milliseconds.
    """

    stage1: Detections
    stage2: Detections
    final: Detections
    clusters: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    ms: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def none() -> Candidates:
        return Candidates(Detections.none(), Detections.none(), Detections.none())


def select_by_height(boxes: np.ndarray, seed_height: float, params: HeightParams) -> np.ndarray:
    """Return a mask (K,) bool of the boxes with |h - h_seed| <= tolerance (Section 3.5)."""
    return np.abs(boxes[:, 5] - seed_height) <= params.tolerance


def refine_clusters(
    xyz: np.ndarray,
    labels: np.ndarray,
    boxes: np.ndarray,
    seeds: Sequence[Seed],
    params: PipelineParams = PipelineParams(),
) -> Candidates:
    """Find the candidates among clusters 1..K. The score of a cluster is the highest over all seeds.

    Args:
        xyz: (N, 3) points.
        labels: (N,) cluster of each point, 0 for none.
        boxes: (K, 7) boxes of the clusters, snapped to the ground.
        seeds: Seed pedestrians. Without one there are no candidates.
    """
    t0 = perf_counter()
    has_seed_height = np.zeros((len(seeds), len(boxes)), bool)
    for mask, seed in zip(has_seed_height, seeds):
        mask[:] = select_by_height(boxes, seed.height, params.height)
    indices = np.flatnonzero(has_seed_height.any(axis=0))
    has_seed_height = has_seed_height[:, indices]
    boxes = boxes[indices]
    floors = boxes[:, 2] - boxes[:, 5] / 2
    t1 = perf_counter()
    templates = [seed.draw_silhouette(params) for seed in seeds]
    points, start = group_points(xyz, labels, indices + 1)
    images = draw_silhouettes(points, start, np.ones((len(indices), 1)), floors, params)
    stm_scores = np.zeros(has_seed_height.shape)
    for scores, template in zip(stm_scores, templates):
        scores[:] = compute_similarity(images, template, params.stm)
    t2 = perf_counter()
    ranges = np.hypot(boxes[:, 0], boxes[:, 1])
    scales = compute_cpa_scales(ranges, params.cpa)
    augmented_indices = np.flatnonzero((scales < 1.0).any(axis=1))
    cpa_scores = stm_scores.copy()
    if len(augmented_indices):
        images = draw_silhouettes(
            *group_points(xyz, labels, indices[augmented_indices] + 1),
            scales[augmented_indices],
            floors[augmented_indices],
            params,
        )
        for scores, template in zip(cpa_scores, templates):
            scores[augmented_indices] = compute_similarity(images, template, params.stm)
    t3 = perf_counter()
    threshold = params.stm.threshold
    if params.confidence.enabled:
        threshold = params.confidence.threshold
        shape = compute_shape_features(points, start, boxes, params)
        for seed, *similarities in zip(seeds, stm_scores, cpa_scores):
            # The seed's own cluster always has a similarity of 1, which carries no information.
            is_seed = find_seed_cluster(seed, points, start)
            seed_confidence = compute_confidence(shape) if seed.confidence is None else seed.confidence
            height_difference = shape["height_m"] - seed.height
            for scores in similarities:
                scores[:] = np.where(is_seed, seed_confidence, compute_confidence(shape, scores, height_difference))
    stm_scores, cpa_scores = (
        np.where(has_seed_height, scores, -np.inf).max(axis=0, initial=-np.inf) for scores in (stm_scores, cpa_scores)
    )
    t4 = perf_counter()

    def make_detections(scores: np.ndarray, mask: np.ndarray) -> Detections:
        return Detections.of(boxes[mask], PEDESTRIAN, scores[mask])

    return Candidates(
        make_detections(stm_scores, np.ones(len(indices), bool)),
        make_detections(stm_scores, stm_scores >= threshold),
        make_detections(cpa_scores, cpa_scores >= threshold),
        indices[cpa_scores >= threshold] + 1,
        dict(height=(t1 - t0) * 1e3, stm=(t2 - t1) * 1e3, cpa=(t3 - t2) * 1e3, confidence=(t4 - t3) * 1e3),
    )
