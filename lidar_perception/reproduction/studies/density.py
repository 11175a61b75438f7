"""Question 7: a far pedestrian is drawn in stripes and the near seed is solid. Ways to compare
like with like, and a softer height filter."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np

from lidar_perception.candidates.configurations import BEST, PAPER
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.seeds import MIN_POINTS, Seed
from lidar_perception.candidates.segmented_cloud import SegmentedCloud
from lidar_perception.candidates.silhouette import (
    compute_cpa_scales,
    compute_similarity,
    draw_silhouettes,
)
from lidar_perception.param_fields import flatten, with_values
from lidar_perception.reproduction.labelled import Labelled, nearest_seed
from lidar_perception.reproduction.variants import (
    NOTHING,
    Found,
    clusters_as_tall,
    found_with,
    seed_of,
    study,
    with_copies,
)
from lidar_perception.types import InputError

SPREAD = with_values(PAPER, {"stm.spread": True, "stm.dilations": 0, "cpa.steps": 0})
METRIC = with_values(SPREAD, {"stm.window": "metric", "stm.shifts": 2})
VARIANTS = {
    "the paper": PAPER,
    "height within 0.3 m": with_values(PAPER, {"height.tolerance": 0.3}),
    "height within 0.5 m": with_values(PAPER, {"height.tolerance": 0.5}),
    "points spread": SPREAD,
    "spread, metric window": METRIC,
    "spread, metric, threshold 0.6": with_values(METRIC, {"stm.threshold": 0.6}),
    "spread, metric, seen rows, threshold 0.6": with_values(METRIC, {"stm.threshold": 0.6,
                                                                     "stm.seen_only": True}),
    "the same, height within 0.3 m": with_values(METRIC, {
        "stm.threshold": 0.6, "stm.seen_only": True, "height.tolerance": 0.3}),
    "best": BEST,
}
THINNED, KERNEL = "seed thinned to the range", "kernel by beam spacing"
NAMES = (*VARIANTS, THINNED, KERNEL)


def thinned(seed: Seed, factor: float, params: PipelineParams = PAPER) -> Seed:
    """The seed as it would be seen `factor` times as far away: of the cells of the sensor's
    sampling at that range, one point each."""
    if factor <= 1:
        return seed
    step = np.radians([params.resolution.azimuth_step, params.resolution.elevation_step]) * factor
    x, y, z = seed.xyz.T.astype(float)
    across = np.hypot(x, y)
    cells = np.floor(np.column_stack([np.arctan2(y, x), np.arctan2(z, across)]) / step)
    _, first = np.unique(cells.astype(int), axis=0, return_index=True)
    return Seed(seed.xyz[np.sort(first)], seed.floor, seed.height)


def find(labelled: Labelled, segments: Callable[[PipelineParams], SegmentedCloud]
         ) -> dict[str, Found]:
    """Candidates by variant."""
    found = {}
    for name, params in VARIANTS.items():
        segmented = segments(params)
        found[name] = found_with(segmented, functools.partial(seed_of, segmented, labelled, params),
                                 params)
    segmented = segments(PAPER)
    try:
        seed = nearest_seed(segmented, labelled)
    except InputError:
        return found | dict.fromkeys((THINNED, KERNEL), NOTHING)
    boxes, points, start = clusters_as_tall(segmented, [seed], PAPER)
    ranges = np.hypot(boxes[:, 0], boxes[:, 1])
    scales = compute_cpa_scales(ranges, PAPER.cpa)
    images = with_copies(boxes, points, start, PAPER)
    own = np.hypot(*seed.xyz[:, :2].mean(axis=0))
    alike = np.zeros((2, len(boxes)))
    for k, r in enumerate(ranges):
        like = thinned(seed, r / own)
        if len(like.xyz) >= MIN_POINTS // 2:
            alike[0, k] = compute_similarity(images[k:k + 1], like.silhouette(PAPER))[0]
        wide = with_values(PAPER, {"stm.dilations": _kernel(r, seed.height)})
        part = points[start[k]:start[k + 1]]
        image = draw_silhouettes(part, np.array([0, len(part)]), scales[k:k + 1], params=wide)
        near = with_values(PAPER, {"stm.dilations": _kernel(own, seed.height)})
        alike[1, k] = compute_similarity(image, seed.silhouette(near))[0]
    return found | {name: Found(boxes, row, PAPER.stm.threshold)
                    for name, row in zip((THINNED, KERNEL), alike)}


def _kernel(metres: float, height: float) -> int:
    """Dilations that close the gap between two beams at this range, in a window of 80 rows that a
    person of this height fills."""
    gap = metres * np.radians(PAPER.resolution.elevation_step) / height * 80
    return int(np.clip(np.ceil((gap - 1) / 2), 1, 10))


STUDY = study("density", "Density",
              "Most pedestrians are lost because far silhouettes are stripes: what mends that?",
              find, NAMES, {"paper": flatten(PAPER), "best": flatten(BEST)})
