"""Sources of seed pedestrians: labels, a click or a template. For the automatic seed, see detectors.automatic_seed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lidar_perception.candidates.params import SeedParams
from lidar_perception.candidates.seeds import Seed, seed_from_click, seed_from_truth
from lidar_perception.candidates.segmented_cloud import SegmentedCloud

# Function that returns one or more seeds for a segmented cloud. The most similar seed of a cluster counts.
SeedSource = Callable[[SegmentedCloud], tuple[Seed, ...]]


def make_truth_source(pedestrians: np.ndarray) -> SeedSource:
    """Make a source whose seed is the nearest of the labelled pedestrians (M, 7), as in the paper."""
    return lambda segmented: (seed_from_truth(segmented.xyz, segmented.ground, pedestrians),)


def make_click_source(click: np.ndarray, params: SeedParams = SeedParams()) -> SeedSource:
    """Make a source whose seed is the cluster at a clicked point (3,) in the LiDAR frame."""
    return lambda segmented: (
        seed_from_click(click, segmented.xyz, segmented.cluster_ids, segmented.boxes, params.click_radius),
    )


def make_fixed_source(*seeds: Seed) -> SeedSource:
    """Make a source that returns the same seeds for every cloud."""
    return lambda segmented: seeds
