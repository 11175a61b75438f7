"""Question 1: how much depends on the seed, and can it come without ground truth?"""

from __future__ import annotations

import functools
import zlib
from collections.abc import Callable

import numpy as np

from lidar_perception.candidates.configurations import BEST, PAPER
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.seeds import MIN_POINTS, Seed, seed_from_click, seed_from_points
from lidar_perception.candidates.segmented_cloud import SegmentedCloud
from lidar_perception.candidates.silhouette import compute_similarity
from lidar_perception.geometry import points_in_box
from lidar_perception.param_fields import flatten, with_values
from lidar_perception.reproduction.labelled import Labelled, nearest_seed
from lidar_perception.reproduction.studies.bank import FRONT, SIDE, template_bank
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

NEAR = 20.0         # metres; who clicks picks somebody near
CLICK_ERROR = 0.3   # metres, standard deviation in x and y of a click beside the true centre
CLICK_RADIUS = 2.0  # metres
HEIGHTS = (1.2, 2.1)  # metres, of a random cluster that one would call a person
SEVERAL = 3
COMBINED: dict[str, Callable[..., np.ndarray]] = {"maximum": np.max, "mean": np.mean}


def _one(segmented: SegmentedCloud, labelled: Labelled, rng: np.random.Generator
         ) -> dict[str, Callable[[PipelineParams], Seed]]:
    """Sources of a single seed."""
    def click(params: PipelineParams) -> Seed:
        near = labelled.pedestrians[np.hypot(*labelled.pedestrians[:, :2].T) < NEAR]
        if len(near) == 0:
            raise InputError("no pedestrian near enough to click")
        place = near[rng.integers(len(near)), :3] + rng.normal(0, [CLICK_ERROR, CLICK_ERROR, 0.2])
        return seed_from_click(place, segmented.xyz, segmented.cluster_ids, segmented.boxes,
                               CLICK_RADIUS)

    def random_near(params: PipelineParams) -> Seed:
        boxes, size = segmented.boxes, np.bincount(segmented.cluster_ids)
        likely = np.flatnonzero((np.hypot(boxes[:, 0], boxes[:, 1]) < NEAR)
                                & (boxes[:, 5] > HEIGHTS[0]) & (boxes[:, 5] < HEIGHTS[1])
                                & (np.resize(size[1:], len(boxes)) >= MIN_POINTS))
        if len(likely) == 0:
            raise InputError("no near cluster as tall as a person")
        k = likely[rng.integers(len(likely))]
        return seed_from_points(segmented.xyz[segmented.cluster_ids == k + 1], boxes[k])

    return {
        "nearest truth": lambda params: nearest_seed(segmented, labelled),
        "click within 20 m": click,
        "random near cluster": random_near,
        "automatic": lambda params: seed_of(segmented, labelled,
                                            with_values(params, {"seed.source": "automatic"})),
        "template": lambda params: seed_of(segmented, labelled,
                                           with_values(params, {"seed.source": "file"})),
    }


def _several(segmented: SegmentedCloud, labelled: Labelled) -> list[Seed]:
    """Seeds of the nearest pedestrians that have enough points."""
    order = np.argsort(np.hypot(*labelled.pedestrians[:, :2].T))
    seeds: list[Seed] = []
    for box in labelled.pedestrians[order]:
        inside = points_in_box(segmented.xyz, box) & ~segmented.ground
        if inside.sum() >= MIN_POINTS and len(seeds) < SEVERAL:
            seeds.append(seed_from_points(segmented.xyz[inside], box))
    return seeds


def _found_with_several(segmented: SegmentedCloud, seeds: list[Seed], params: PipelineParams,
                        combine: Callable[..., np.ndarray]) -> Found:
    """Candidates by what their similarities to the seeds (T, K) combine to; the height may be that
    of any of them."""
    if not seeds:
        return NOTHING
    boxes, points, start = clusters_as_tall(segmented, seeds, params)
    images = with_copies(boxes, points, start, params)
    alike = np.stack([compute_similarity(images, seed.silhouette(params), params.stm)
                      for seed in seeds])
    return Found(boxes, combine(alike, axis=0), params.stm.threshold)


def _banked(segmented: SegmentedCloud, seed: Seed, params: PipelineParams, views: tuple[float, ...]
            ) -> Found:
    """Candidates by their likeness to the simulated pedestrian of their own range, seen from one
    of the views; the seed gives the height."""
    bank = template_bank()
    boxes, points, start = clusters_as_tall(segmented, [seed], params)
    images = with_copies(boxes, points, start, params)
    ranges = np.array(sorted({r for r, _ in bank}))
    nearest = np.abs(np.hypot(boxes[:, 0], boxes[:, 1])[:, None] - ranges).argmin(axis=1)
    alike = np.zeros(len(boxes))
    for i, r in enumerate(ranges):
        for view in views:
            own = compute_similarity(images, bank[r, view].silhouette(params), params.stm)
            alike = np.maximum(alike, np.where(nearest == i, own, 0.0))
    return Found(boxes, alike, params.stm.threshold)


def find(labelled: Labelled, segments: Callable[[PipelineParams], SegmentedCloud]
         ) -> dict[str, Found]:
    """Candidates by variant."""
    found = {}
    seed = zlib.crc32(np.ascontiguousarray(labelled.pedestrians).tobytes())
    for name, params in CONFIGURED.items():
        segmented = segments(params)
        one = _one(segmented, labelled, np.random.default_rng(seed))
        for source, make in one.items():
            found[f"{name}, {source}"] = found_with(segmented, functools.partial(make, params),
                                                    params)
    segmented = segments(PAPER)
    several = _several(segmented, labelled)
    for label, combine in COMBINED.items():
        found[f"paper, {SEVERAL} nearest truths, {label}"] = _found_with_several(
            segmented, several, PAPER, combine)
    for label, views in (("front", (FRONT,)), ("side", (SIDE,)), ("front and side", (FRONT, SIDE))):
        try:
            found[f"paper, simulated by range, {label}"] = _banked(
                segmented, nearest_seed(segmented, labelled), PAPER, views)
        except InputError:
            found[f"paper, simulated by range, {label}"] = NOTHING
    return found


CONFIGURED = {"paper": PAPER, "best": BEST}
SOURCES = ("nearest truth", "click within 20 m", "random near cluster", "automatic", "template")
NAMES = [f"{name}, {source}" for name in CONFIGURED for source in SOURCES] + [
    f"paper, {SEVERAL} nearest truths, {label}" for label in ("maximum", "mean")] + [
    f"paper, simulated by range, {label}" for label in ("front", "side", "front and side")]
STUDY = study("seeds", "Seeds", "How much does the seed matter, and can it come without labels?",
              find, NAMES, {name: flatten(params) for name, params in CONFIGURED.items()})
