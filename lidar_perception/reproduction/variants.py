"""Settings of the candidate pipeline side by side on the same frames: what the studies share."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from lidar_perception.candidates.boxes import select_by_height
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import refine_segmented
from lidar_perception.candidates.seed_sources import make_automatic_source
from lidar_perception.candidates.seeds import Seed, load_seed
from lidar_perception.candidates.segmented_cloud import SegmentedCloud
from lidar_perception.candidates.silhouette import compute_cpa_scales, draw_silhouettes
from lidar_perception.data.frame import Frame
from lidar_perception.groups import group_points
from lidar_perception.param_fields import flatten, with_values
from lidar_perception.reproduction.experiment import (
    Cell,
    Experiment,
    Figure,
    Panel,
    Row,
    Section,
    Table,
)
from lidar_perception.reproduction.labelled import Labelled, load_labelled, nearest_seed
from lidar_perception.reproduction.statistics import bootstrap, cells, curve, rates, stack
from lidar_perception.scoring.centres.matching import RANGE_NAMES, count_by_range, match_centres
from lidar_perception.types import InputError

SHOWN = RANGE_NAMES[:4]  # beyond 60 m there is hardly anything to score
MAX_LINES = 6  # in a figure, which has as many colours
MIDDLES = (7.5, 22.5, 37.5, 52.5)  # of these, metres
COUNTS = ("tp", "fp", "fn")

ANY_SCORE = {"stm.threshold": 0.0, "confidence.threshold": 0.0}


class Found(NamedTuple):
    """Candidates of one variant before the decision: boxes (K, 7), scores (K,), and the threshold
    from which they are accepted. given (7,) is a true box that is not to be found: it and the
    candidate on it do not count."""

    boxes: np.ndarray
    scores: np.ndarray
    threshold: float
    given: np.ndarray | None = None

    @property
    def accepted(self) -> np.ndarray:
        """(A, 7) the boxes that reach the threshold."""
        return self.boxes[self.scores >= self.threshold]


NOTHING = Found(np.zeros((0, 7), np.float32), np.zeros(0), 0.0)

# What a study does with a frame: what each of its variants finds.
Finder = Callable[[Labelled, Callable[[PipelineParams], SegmentedCloud]], dict[str, Found]]


def compared_variants(name: str, title: str, question: str, variants: Mapping[str, PipelineParams]
            ) -> Experiment:
    """A study whose variants are settings; the first is what the others are compared with."""
    return study(name, title, question, functools.partial(by_settings, dict(variants)),
                 tuple(variants), {k: flatten(v) for k, v in variants.items()})


def study(name: str, title: str, question: str, find: Finder, variants: Sequence[str],
          settings: dict[str, Any]) -> Experiment:
    """A study with a function of its own, of a module, that finds boxes by variant."""
    return Experiment(name, title, question, functools.partial(measured_variants, find),
                      functools.partial(sections, title, tuple(variants)), settings)


def measured_variants(find: Finder, frames: Sequence[Frame], number: int) -> dict[str, Any]:
    """The record of one frame: variant -> see score()."""
    labelled = load_labelled(frames[number])
    return {"frame": frames[number].name,
            "variants": {name: score(found, labelled.pedestrians)
                         for name, found in find(labelled, segments_of(labelled)).items()}}


def score(found: Found, truth: np.ndarray) -> dict[str, list]:
    """tp, fp and fn by RANGE_NAMES of what is accepted, with true boxes (M, 7); ranked: [score,
    1 hit | 0] of every candidate, where each pedestrian has at most one hit whatever the scores."""
    if found.given is not None:
        own, _ = match_centres(found.boxes, found.given[None])
        truth = truth[(truth != found.given).any(axis=1)]
        found = Found(np.delete(found.boxes, own, axis=0), np.delete(found.scores, own),
                      found.threshold)
    accepted = found.accepted
    counts = count_by_range(accepted, truth, match_centres(accepted, truth))
    return {**{name: count.tolist() for name, count in zip(COUNTS, counts)},
            "ranked": ranked(found.boxes, found.scores, truth)}


def ranked(boxes: np.ndarray, scores: np.ndarray, truth: np.ndarray) -> list[list[float]]:
    """[score, 1 hit | 0] of each of the boxes (K, 7), matched with true ones (M, 7) before the
    scores are looked at: each pedestrian has at most one hit."""
    hits = np.isin(np.arange(len(boxes)), match_centres(boxes, truth)[0])
    return [[round(float(s), 4), int(h)] for s, h in zip(scores, hits)]


def segments_of(labelled: Labelled) -> Callable[[PipelineParams], SegmentedCloud]:
    """Segments the frame for given settings, and remembers what was done for the same ones."""
    done: dict[tuple, SegmentedCloud] = {}

    def segments(params: PipelineParams) -> SegmentedCloud:
        key = (params.view, params.ground, params.clustering, params.boxes)
        if key not in done:
            done[key] = labelled.segmented(params)
        return done[key]

    return segments


def seed_of(segmented: SegmentedCloud, labelled: Labelled, params: PipelineParams) -> Seed:
    """The seed from the source that params names. InputError where there is none."""
    if params.seed.source == "ground_truth":
        return nearest_seed(segmented, labelled)
    template = load_seed(params.seed.file)
    if params.seed.source == "automatic":
        return make_automatic_source(template, params)(segmented)
    return template


def found_with(segmented: SegmentedCloud, seed: Callable[[], Seed],
               params: PipelineParams) -> Found:
    """The candidates of the last stage; none where there is no seed."""
    try:
        all_ = refine_segmented(segmented, lambda _: seed(), with_values(params, ANY_SCORE)).final
    except InputError:
        return NOTHING
    return Found(all_.boxes, all_.scores, (params.confidence if params.confidence.enabled
                                           else params.stm).threshold)


def clusters_as_tall(segmented: SegmentedCloud, seeds: Sequence[Seed], params: PipelineParams
                     ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """boxes (K, 7) of the clusters whose height is that of one of the seeds, and their points
    (N, 3) and start (K + 1,) as silhouettes() takes them."""
    tall = [select_by_height(segmented.boxes, seed.height, params.height) for seed in seeds]
    kept = np.flatnonzero(np.any(tall, axis=0))
    return segmented.boxes[kept], *group_points(segmented.xyz, segmented.cluster_ids, kept + 1)


def with_copies(boxes: np.ndarray, points: np.ndarray, start: np.ndarray, params: PipelineParams
                ) -> np.ndarray:
    """(K, 80) silhouettes of such clusters with CPA as params has it."""
    scales = compute_cpa_scales(np.hypot(boxes[:, 0], boxes[:, 1]), params.cpa)
    return draw_silhouettes(points, start, scales, boxes[:, 2] - boxes[:, 5] / 2, params)


def by_settings(variants: Mapping[str, PipelineParams], labelled: Labelled,
                segments: Callable[[PipelineParams], SegmentedCloud]) -> dict[str, Found]:
    """What each of the settings finds."""
    found = {}
    for name, params in variants.items():
        segmented = segments(params)
        found[name] = found_with(segmented, functools.partial(seed_of, segmented, labelled, params),
                                 params)
    return found


def sections(title: str, names: Sequence[str], records: list[dict[str, Any]], key: str = "all"
             ) -> list[Section]:
    """One section, whose tables are called after the key: scores of each variant with intervals,
    the difference of F1 to the first on the same frames, and F1 by range."""
    records = [r for r in records if "skipped" not in r]
    counts = {name: stack([[r["variants"][name][k] for k in COUNTS] for r in records],
                          3, len(RANGE_NAMES)) for name in names}
    scores = {name: bootstrap(c, _scores) for name, c in counts.items()}
    overall: list[Row] = []
    by_range: list[Row] = []
    for name in names:
        both = np.stack([counts[name], counts[names[0]]], axis=1)
        gain = bootstrap(both, _gain)[:, None]
        overall.append((name, *cells(scores[name][:, -1]),
                        *(cells(gain) if name != names[0] else ("",)),
                        Cell(best_f1([r["variants"][name]["ranked"] for r in records],
                                     counts[name][:, [0, 2]].sum())),
                        *(str(int(n)) for n in counts[name].sum(axis=(0, 2)))))
        by_range.append((name, *cells(scores[name][:, :len(SHOWN), 2])))
    truth = stack([np.add(r["variants"][names[0]]["tp"], r["variants"][names[0]]["fn"])
                   for r in records], len(RANGE_NAMES)).sum(axis=0)
    lines = tuple(curve(name, MIDDLES, scores[name][:, :len(SHOWN), 2])
                  for name in _most_telling(scores))
    return [Section(title, f"{len(records)} frames with {int(truth.sum())} pedestrians; a hit is a "
                    "3D centre within 1.0 m, one to one. Intervals: 95 %, bootstrap by frame.",
                    (Table(f"{key}_variants", "All ranges",
                           ("variant", "recall [%]", "precision [%]", "F1 [%]",
                            f"F1 above '{names[0]}' [points]", "F1, any threshold [%]", "TP", "FP",
                            "FN"), tuple(overall),
                           "Any threshold: the best that these very frames allow, so that ways to "
                           "draw can be compared whose similarities differ."),
                     Table(f"{key}_by_range", "F1 by range",
                           ("variant", *(f"{r} m, n = {int(n)} [%]"
                                         for r, n in zip(SHOWN, truth))), tuple(by_range))),
                    (Figure(f"{key}_by_range", "F1 by range",
                            (Panel("", "middle of the range [m]", "F1 [%]", lines),)),))]


def _most_telling(scores: dict[str, np.ndarray]) -> list[str]:
    """The MAX_LINES variants with the largest F1 over all ranges, in their order."""
    best = sorted(scores, key=lambda name: -np.nan_to_num(scores[name][0, -1, 2]))[:MAX_LINES]
    return [name for name in scores if name in best]


def best_f1(ranked: list[list], truth: float) -> float | None:
    """The largest F1 in percent over all thresholds; None without pedestrians."""
    pairs = np.array([pair for frame in ranked for pair in frame], float).reshape(-1, 2)
    if truth == 0:
        return None
    order = np.argsort(-pairs[:, 0], kind="stable")
    hits = np.cumsum(pairs[order, 1])
    last = np.append(np.diff(pairs[order, 0]) != 0, True)[:len(pairs)]  # equal scores go together
    f1 = 2 * hits / (np.arange(1, len(pairs) + 1) + truth)
    return 100 * float(f1[last].max(initial=0.0))


def _gain(sums: np.ndarray) -> np.ndarray:
    """(...) F1 of the first less that of the second, of sums (..., 2, 3, 5)."""
    f1 = _scores(sums)[..., -1, 2]
    return f1[..., 0] - f1[..., 1]


def _scores(sums: np.ndarray) -> np.ndarray:
    """(..., 6, 3) recall, precision, F1 by range and of all, of sums (..., 3, 5)."""
    sums = np.concatenate([sums, sums.sum(axis=-1, keepdims=True)], axis=-1)
    return rates(*np.moveaxis(sums, -2, 0))
