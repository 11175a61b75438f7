"""Question 3: CPA steps for each cluster by itself, instead of two in one band of range."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lidar_perception.candidates.configurations import PAPER
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.seeds import Seed
from lidar_perception.candidates.segmented_cloud import SegmentedCloud
from lidar_perception.candidates.silhouette import (
    COLUMNS,
    ROWS,
    compute_similarity,
    count_pixels,
    draw_silhouettes,
)
from lidar_perception.param_fields import flatten
from lidar_perception.reproduction.labelled import Labelled, nearest_seed
from lidar_perception.reproduction.variants import NOTHING, Found, clusters_as_tall, study
from lidar_perception.types import InputError

MAX_STEPS = 8
FIRST_RANGE, METRES_A_STEP = 15.0, 7.5  # by range: a first step from here on, another each 7.5 m
FULL_COUNT = 200                        # by points: a step each time they halve below this
MIN_FILL = 0.8                        # by fill: until the image is as full as 0.8 of the seed's


def _copies(steps: np.ndarray) -> np.ndarray:
    """(K, 1 + MAX_STEPS) scales of so many copies (K,) for each cluster; 1 adds none."""
    k = np.arange(1 + MAX_STEPS)
    scales = np.maximum(PAPER.cpa.min_scale, 1.0 - k * PAPER.cpa.decrement)
    return np.where(k <= steps[:, None], scales, 1.0)


def by_range(ranges: np.ndarray) -> np.ndarray:
    """(K,) steps for horizontal ranges (K,) in metres."""
    return np.clip(np.ceil((ranges - FIRST_RANGE) / METRES_A_STEP), 0, MAX_STEPS)


def by_points(counts: np.ndarray) -> np.ndarray:
    """(K,) steps for clusters of so many points (K,)."""
    return np.clip(np.ceil(np.log2(FULL_COUNT / np.maximum(counts, 1))), 0, MAX_STEPS)


def find(labelled: Labelled, segments: Callable[[PipelineParams], SegmentedCloud]
         ) -> dict[str, Found]:
    """Candidates by variant."""
    segmented = segments(PAPER)
    try:
        seed = nearest_seed(segmented, labelled)
    except InputError:
        return dict.fromkeys(NAMES, NOTHING)
    boxes, points, start = clusters_as_tall(segmented, [seed], PAPER)
    ranges = np.hypot(boxes[:, 0], boxes[:, 1])
    band = (ranges >= PAPER.cpa.min_range) & (ranges < PAPER.cpa.max_range)
    steps = {
        "none": np.zeros(len(boxes)),
        "2 in 15-30 m (the paper)": np.where(band, PAPER.cpa.steps, 0),
        "by range": by_range(ranges),
        "by points": by_points(np.diff(start)),
        "by fill": _by_fill(points, start, seed),
    }
    template = seed.silhouette(PAPER)
    return {name: Found(boxes, compute_similarity(draw_silhouettes(points, start, _copies(number)),
                                                  template),
                        PAPER.stm.threshold) for name, number in steps.items()}


def _by_fill(points: np.ndarray, start: np.ndarray, seed: Seed) -> np.ndarray:
    """(K,) the fewest steps after which a silhouette is as full as the seed's, nearly."""
    wanted = MIN_FILL * count_pixels(seed.silhouette(PAPER)[None])[0] / (ROWS * COLUMNS)
    clusters = len(start) - 1
    fill = np.stack([count_pixels(draw_silhouettes(points, start,
                                                   _copies(np.full(clusters, steps))))
                     for steps in range(MAX_STEPS + 1)]) / (ROWS * COLUMNS)
    enough = fill >= wanted
    return np.where(enough.any(axis=0), enough.argmax(axis=0), MAX_STEPS)


NAMES = ("none", "2 in 15-30 m (the paper)", "by range", "by points", "by fill")
STUDY = study("adaptive", "Adaptive CPA", "Does it help to choose the steps for each cluster?",
              find, NAMES, {"paper": flatten(PAPER)})
