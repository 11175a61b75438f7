"""Sources of seed pedestrians: labels, a click, a template, or the cloud itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from lidar_perception.candidates.confidence import compute_confidence, compute_shape_features
from lidar_perception.candidates.params import PipelineParams, SeedParams
from lidar_perception.candidates.seeds import MIN_POINTS, Seed, seed_from_click, seed_from_points, seed_from_truth
from lidar_perception.candidates.segmented_cloud import SegmentedCloud
from lidar_perception.groups import group_points

# Returns one or more seeds for a segmented cloud; clusters are compared with the most similar one.
SeedSource = Callable[[SegmentedCloud], tuple[Seed, ...]]


def make_truth_source(pedestrians: np.ndarray) -> SeedSource:
    """Make a source whose seed is the nearest of the labelled pedestrians (M, 7), as in the paper."""
    return lambda segmented: (seed_from_truth(segmented.xyz, segmented.ground, pedestrians),)


def make_click_source(click: np.ndarray, params: SeedParams = SeedParams()) -> SeedSource:
    """Make a source whose seed is the cluster at a clicked point (3,) in the LiDAR frame."""
    return lambda segmented: (
        seed_from_click(click, segmented.xyz, segmented.cluster_ids, segmented.boxes, params.click_radius),
    )


def make_automatic_source(templates: Sequence[Seed], params: PipelineParams) -> SeedSource:
    """Make a source whose seed is the cluster with the highest confidence of being a pedestrian.

    If this confidence is below params.seed.min_confidence, the templates are the seeds.
    """

    def source(segmented: SegmentedCloud) -> tuple[Seed, ...]:
        clusters = np.arange(1, len(segmented.boxes) + 1)
        confidence = compute_confidence(
            compute_shape_features(
                *group_points(segmented.xyz, segmented.cluster_ids, clusters), segmented.boxes, params
            )
        )
        confidence[np.bincount(segmented.cluster_ids, minlength=len(segmented.boxes) + 1)[1:] < MIN_POINTS] = -1.0
        if confidence.max(initial=-1.0) < params.seed.min_confidence:  # -1 < 0 if there are no clusters
            return tuple(templates)
        best = int(confidence.argmax())
        return (seed_from_points(segmented.xyz[segmented.cluster_ids == best + 1], segmented.boxes[best]),)

    return source


def make_fixed_source(*seeds: Seed) -> SeedSource:
    """Make a source that returns the same seeds for every cloud."""
    return lambda segmented: seeds
