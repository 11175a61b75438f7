"""Where a frame's seed pedestrian comes from: labels, a click, a template, the frame itself."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lidar_perception.candidates.confidence import confidence, shape_features
from lidar_perception.candidates.params import PipelineParams, SeedParams
from lidar_perception.candidates.seeds import (
    MIN_POINTS,
    Seed,
    seed_from_click,
    seed_from_points,
    seed_from_truth,
)
from lidar_perception.candidates.segmented import Segmented
from lidar_perception.groups import group_points

# The seed, given the frame's clusters.
SeedSource = Callable[[Segmented], Seed]


def truth_seed(pedestrians: np.ndarray) -> SeedSource:
    """Nearest pedestrian of boxes (M, 7), the paper's protocol."""
    return lambda s: seed_from_truth(s.xyz, s.ground, pedestrians)


def clicked_seed(click: np.ndarray, params: SeedParams = SeedParams()) -> SeedSource:
    """The cluster at a point (3,) in the LiDAR frame."""
    return lambda s: seed_from_click(click, s.xyz, s.cluster_ids, s.boxes, params.click_radius)


def automatic_seed(template: Seed, params: PipelineParams) -> SeedSource:
    """The cluster of the frame that is most like a pedestrian, or the template where none is."""
    def source(s: Segmented) -> Seed:
        clusters = np.arange(1, len(s.boxes) + 1)
        likely = confidence(shape_features(*group_points(s.xyz, s.cluster_ids, clusters), s.boxes,
                                           params))
        likely[np.bincount(s.cluster_ids, minlength=len(s.boxes) + 1)[1:] < MIN_POINTS] = -1.0
        if likely.max(initial=-1.0) < params.seed.min_confidence:  # which may be 0
            return template
        best = int(likely.argmax())
        return seed_from_points(s.xyz[s.cluster_ids == best + 1], s.boxes[best])
    return source


def fixed_seed(seed: Seed) -> SeedSource:
    """The same seed in every frame."""
    return lambda s: seed
