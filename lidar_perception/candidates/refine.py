"""Clusters to pedestrian candidates: ground snapping, height filter, STM, CPA (paper A)."""

from __future__ import annotations

from dataclasses import dataclass, field
from time import perf_counter

import numpy as np

from lidar_perception.candidates.boxes import height_matches
from lidar_perception.candidates.confidence import confidence, shape_features
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.seeds import Seed, own_cluster
from lidar_perception.candidates.silhouette import cpa_scales, silhouettes, similarity
from lidar_perception.groups import group_points
from lidar_perception.types import PEDESTRIAN, Detections

STAGES = ("stage1", "stage2", "final")


@dataclass(frozen=True)
class Candidates:
    """Detections after the height filter (stage1), STM (stage2) and STM with CPA (final); scores
    are the similarity with the seed (stage1: without CPA), or the confidence where that is on.
    clusters (K,) int64: the numbers of the clusters of `final`, ascending. ms: time of each step.
    """

    stage1: Detections
    stage2: Detections
    final: Detections
    clusters: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    ms: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def none() -> Candidates:
        return Candidates(Detections.none(), Detections.none(), Detections.none())


def refine(xyz: np.ndarray, labels: np.ndarray, boxes: np.ndarray, seed: Seed,
           params: PipelineParams = PipelineParams()) -> Candidates:
    """Candidates among clusters 1..K of points (N, 3), ids (N,), ground-snapped boxes (K, 7)."""
    t0 = perf_counter()
    kept = np.flatnonzero(height_matches(boxes, seed.height, params.height))
    boxes = boxes[kept]
    floors = boxes[:, 2] - boxes[:, 5] / 2
    t1 = perf_counter()
    template = seed.silhouette(params)
    points, start = group_points(xyz, labels, kept + 1)
    plain = similarity(silhouettes(points, start, np.ones((len(kept), 1)), floors, params),
                       template, params.stm)
    t2 = perf_counter()
    ranges = np.hypot(boxes[:, 0], boxes[:, 1])
    scales = cpa_scales(ranges, params.cpa)
    chosen = np.flatnonzero((scales < 1.0).any(axis=1))
    final = plain.copy()
    if len(chosen):
        augmented = group_points(xyz, labels, kept[chosen] + 1)
        final[chosen] = similarity(silhouettes(*augmented, scales[chosen], floors[chosen], params),
                                   template, params.stm)
    t3 = perf_counter()
    threshold = params.stm.threshold
    if params.confidence.enabled:
        threshold = params.confidence.threshold
        shape = shape_features(points, start, boxes, params)
        # The seed is as like itself as can be, which says nothing: it is what it was taken for.
        own = own_cluster(seed, points, start)
        itself = 1.0 if seed.certain else confidence(shape)
        plain, final = (np.where(own, itself, confidence(shape, alike, shape["height_m"]
                                                         - seed.height))
                        for alike in (plain, final))
    t4 = perf_counter()

    def detections(scores: np.ndarray, accepted: np.ndarray) -> Detections:
        return Detections.of(boxes[accepted], PEDESTRIAN, scores[accepted])

    return Candidates(detections(plain, np.ones(len(kept), bool)),
                      detections(plain, plain >= threshold),
                      detections(final, final >= threshold),
                      kept[final >= threshold] + 1,
                      dict(height=(t1 - t0) * 1e3, stm=(t2 - t1) * 1e3, cpa=(t3 - t2) * 1e3,
                           confidence=(t4 - t3) * 1e3))
