"""Clusters to pedestrian candidates: height filter, STM and CPA (paper A)."""

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
    """Detections after the height filter (stage1), STM (stage2) and STM with CPA (final).

    Scores are the similarity to the seed (stage1: without CPA) or, if enabled, the confidence.
    clusters (K,) int64 are the ids of the clusters of `final`, ascending; ms is the duration of
    each step.
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
    """Return (K,) bool: |h - h_seed| <= tolerance (Section 3.5)."""
    return np.abs(boxes[:, 5] - seed_height) <= params.tolerance


def refine_clusters(
    xyz: np.ndarray,
    labels: np.ndarray,
    boxes: np.ndarray,
    seeds: Sequence[Seed],
    params: PipelineParams = PipelineParams(),
) -> Candidates:
    """Find the candidates among clusters 1..K of points (N, 3).

    labels (N,) are the points' cluster ids, boxes (K, 7) are snapped to the ground. Of several
    seeds the one that gives a cluster its highest score counts.
    """
    t0 = perf_counter()
    fits = np.array([select_by_height(boxes, seed.height, params.height) for seed in seeds])
    kept = np.flatnonzero(fits.any(axis=0))
    fits = fits[:, kept]
    boxes = boxes[kept]
    floors = boxes[:, 2] - boxes[:, 5] / 2
    t1 = perf_counter()
    templates = [seed.silhouette(params) for seed in seeds]
    points, start = group_points(xyz, labels, kept + 1)
    images = draw_silhouettes(points, start, np.ones((len(kept), 1)), floors, params)
    plain = np.array([compute_similarity(images, template, params.stm) for template in templates])
    t2 = perf_counter()
    ranges = np.hypot(boxes[:, 0], boxes[:, 1])
    scales = compute_cpa_scales(ranges, params.cpa)
    chosen = np.flatnonzero((scales < 1.0).any(axis=1))
    final = plain.copy()
    if len(chosen):
        images = draw_silhouettes(*group_points(xyz, labels, kept[chosen] + 1), scales[chosen], floors[chosen], params)
        for scores, template in zip(final, templates):
            scores[chosen] = compute_similarity(images, template, params.stm)
    t3 = perf_counter()
    threshold = params.stm.threshold
    if params.confidence.enabled:
        threshold = params.confidence.threshold
        shape = compute_shape_features(points, start, boxes, params)
        for seed, *similarities in zip(seeds, plain, final):
            # The similarity of the seed's own cluster carries no information: it is always 1.
            is_seed = find_seed_cluster(seed, points, start)
            seed_confidence = 1.0 if seed.certain else compute_confidence(shape)
            height_difference = shape["height_m"] - seed.height
            for scores in similarities:
                scores[:] = np.where(is_seed, seed_confidence, compute_confidence(shape, scores, height_difference))
    plain, final = (np.where(fits, scores, -np.inf).max(axis=0) for scores in (plain, final))
    t4 = perf_counter()

    def detections(scores: np.ndarray, accepted: np.ndarray) -> Detections:
        return Detections.of(boxes[accepted], PEDESTRIAN, scores[accepted])

    return Candidates(
        detections(plain, np.ones(len(kept), bool)),
        detections(plain, plain >= threshold),
        detections(final, final >= threshold),
        kept[final >= threshold] + 1,
        dict(height=(t1 - t0) * 1e3, stm=(t2 - t1) * 1e3, cpa=(t3 - t2) * 1e3, confidence=(t4 - t3) * 1e3),
    )
