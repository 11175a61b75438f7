"""Sources of the seed pedestrian: labels, a click, a template, or the cloud itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from lidar_perception.candidates.confidence import compute_confidence, compute_shape_features
from lidar_perception.candidates.params import PipelineParams, SeedParams
from lidar_perception.candidates.seeds import MIN_POINTS, Seed, seed_from_click, seed_from_points, seed_from_truth
from lidar_perception.candidates.segmented_cloud import SegmentedCloud
from lidar_perception.groups import group_points

# Returns the seeds for a segmented cloud, one or more; the most similar one counts.
SeedSource = Callable[[SegmentedCloud], tuple[Seed, ...]]


def make_truth_source(pedestrians: np.ndarray) -> SeedSource:
    """Return a source that takes the nearest pedestrian of boxes (M, 7), the paper's protocol."""
    return lambda s: (seed_from_truth(s.xyz, s.ground, pedestrians),)


def make_click_source(click: np.ndarray, params: SeedParams = SeedParams()) -> SeedSource:
    """Return a source that takes the cluster at a point (3,) in the LiDAR frame."""
    return lambda s: (seed_from_click(click, s.xyz, s.cluster_ids, s.boxes, params.click_radius),)


def make_automatic_source(templates: Sequence[Seed], params: PipelineParams) -> SeedSource:
    """Return a source that takes the cluster most likely to be a pedestrian, or the templates."""

    def source(s: SegmentedCloud) -> tuple[Seed, ...]:
        clusters = np.arange(1, len(s.boxes) + 1)
        likely = compute_confidence(
            compute_shape_features(*group_points(s.xyz, s.cluster_ids, clusters), s.boxes, params)
        )
        likely[np.bincount(s.cluster_ids, minlength=len(s.boxes) + 1)[1:] < MIN_POINTS] = -1.0
        if likely.max(initial=-1.0) < params.seed.min_confidence:  # min_confidence may be 0
            return tuple(templates)
        best = int(likely.argmax())
        return (seed_from_points(s.xyz[s.cluster_ids == best + 1], s.boxes[best]),)

    return source


def make_fixed_source(*seeds: Seed) -> SeedSource:
    """Return a source that takes the same seeds for every cloud."""
    return lambda s: seeds
