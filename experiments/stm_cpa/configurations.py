"""Comparison of the configurations `paper` and `best`, with and without a labelled seed.

The figures in docs/explanation/candidates.md come from this experiment.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments.framework.experiment import Cell, Experiment, Figure, Panel, Row, Section, Table
from experiments.framework.statistics import bootstrap, compute_rates, make_cells, make_line, stack_counts
from experiments.stm_cpa.frames import LabelledFrame, find_nearest, load_labelled_frame, make_nearest_seed
from lidar_perception.candidates.configurations import BEST, PAPER
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import refine_segmented
from lidar_perception.candidates.seed_sources import make_automatic_source
from lidar_perception.candidates.seeds import Seed, load_seeds
from lidar_perception.candidates.segmented_cloud import SegmentedCloud
from lidar_perception.data.frame import Frame
from lidar_perception.param_fields import flatten, with_values
from lidar_perception.scoring.centres.matching import RANGE_NAMES, count_by_range, match_centres
from lidar_perception.types import InputError

SOURCES = {"ground_truth": "nearest truth", "automatic": "automatic seed", "file": "template"}
VARIANTS = {
    f"{name}, {title}": with_values(params, {"seed.source": source})
    for source, title in SOURCES.items()
    for name, params in (("paper", PAPER), ("best", BEST))
}
# Variants that are also scored without the seed pedestrian, because its position is given.
WITHOUT_SEED = {f"{name}, nearest truth, it left out": f"{name}, nearest truth" for name in ("paper", "best")}
SHOWN = RANGE_NAMES[:4]  # there are hardly any pedestrians beyond 60 m
RANGE_MIDDLES = (7.5, 22.5, 37.5, 52.5)  # centres of the ranges SHOWN, in metres
COUNTS = ("tp", "fp", "fn")
ANY_SCORE = {"stm.threshold": 0.0, "confidence.threshold": 0.0}


class ScoredBoxes(NamedTuple):
    """Candidates before the decision: boxes (K, 7), scores (K,), and the threshold to accept."""

    boxes: np.ndarray
    scores: np.ndarray
    threshold: float

    @property
    def accepted(self) -> np.ndarray:
        """Boxes (A, 7) that reach the threshold."""
        return self.boxes[self.scores >= self.threshold]


def measure_frame(frames: Sequence[Frame], number: int) -> dict[str, Any]:
    """Measure frame `number` and return its record: variant -> see score_boxes()."""
    labelled = load_labelled_frame(frames[number])
    segment = _remember_segments(labelled)
    found = {name: _find_candidates(segment(params), labelled, params) for name, params in VARIANTS.items()}
    truth = labelled.pedestrians
    variants = {name: score_boxes(boxes, truth) for name, boxes in found.items()}
    for name, source in WITHOUT_SEED.items():
        variants[name] = score_boxes(*drop_given(found[source], truth, find_nearest(truth)))
    return {"frame": frames[number].name, "variants": variants}


def drop_given(found: ScoredBoxes, truth: np.ndarray, given: np.ndarray) -> tuple[ScoredBoxes, np.ndarray]:
    """Drop a given pedestrian (7,) from the true boxes (M, 7), and the candidate on it."""
    own, _ = match_centres(found.boxes, given[None])
    return (
        ScoredBoxes(np.delete(found.boxes, own, axis=0), np.delete(found.scores, own), found.threshold),
        truth[(truth != given).any(axis=1)],
    )


def score_boxes(found: ScoredBoxes, truth: np.ndarray) -> dict[str, list]:
    """Return tp, fp and fn of the accepted boxes by RANGE_NAMES, and `ranked`.

    ranked: [score, 1 hit | 0] of every candidate. Candidates are matched with the true boxes
    (M, 7) regardless of their scores, so that each pedestrian has at most one hit.
    """
    accepted = found.accepted
    counts = count_by_range(accepted, truth, match_centres(accepted, truth))
    hits = np.isin(np.arange(len(found.boxes)), match_centres(found.boxes, truth)[0])
    return {
        **{name: count.tolist() for name, count in zip(COUNTS, counts)},
        "ranked": [[round(float(score), 4), int(hit)] for score, hit in zip(found.scores, hits)],
    }


def _remember_segments(labelled: LabelledFrame) -> Callable[[PipelineParams], SegmentedCloud]:
    """Return a function that segments the frame once for equal parameters."""
    done: dict[tuple, SegmentedCloud] = {}

    def segment(params: PipelineParams) -> SegmentedCloud:
        key = (params.view, params.ground, params.clustering, params.boxes)
        if key not in done:
            done[key] = labelled.segment(params)
        return done[key]

    return segment


def _find_candidates(segmented: SegmentedCloud, labelled: LabelledFrame, params: PipelineParams) -> ScoredBoxes:
    """Return the candidates of the last stage; none where there is no seed."""

    def make_seeds(_: SegmentedCloud) -> tuple[Seed, ...]:
        if params.seed.source == "ground_truth":
            return (make_nearest_seed(segmented, labelled),)
        templates = load_seeds(params.seed.file)
        if params.seed.source == "automatic":
            return make_automatic_source(templates, params)(segmented)
        return templates

    stage = params.confidence if params.confidence.enabled else params.stm
    try:
        found = refine_segmented(segmented, make_seeds, with_values(params, ANY_SCORE)).final
    except InputError:
        return ScoredBoxes(np.zeros((0, 7), np.float32), np.zeros(0), 0.0)
    return ScoredBoxes(found.boxes, found.scores, stage.threshold)


def make_sections(records: list[dict[str, Any]]) -> list[Section]:
    """Return the report: all variants, and those without the seed pedestrian."""
    records = [record["variants"] for record in records if "skipped" not in record]
    return [
        _make_section("The configurations", tuple(VARIANTS), records, "all"),
        _make_section("The seed left out", tuple(WITHOUT_SEED), records, "without_seed"),
    ]


def _make_section(title: str, names: Sequence[str], records: list[dict[str, Any]], key: str) -> Section:
    """Return the scores of each variant, the gain over the first, and F1 by range.

    key: start of the names of the tables.
    """
    counts = {
        name: stack_counts([[r[name][k] for k in COUNTS] for r in records], 3, len(RANGE_NAMES)) for name in names
    }
    scores = {name: bootstrap(c, _compute_scores) for name, c in counts.items()}
    overall: list[Row] = []
    by_range: list[Row] = []
    for name in names:
        both = np.stack([counts[name], counts[names[0]]], axis=1)
        gain = bootstrap(both, _compute_gain)[:, None]
        overall.append(
            (
                name,
                *make_cells(scores[name][:, -1]),
                *(make_cells(gain) if name != names[0] else ("",)),
                Cell(find_best_f1([r[name]["ranked"] for r in records], counts[name][:, [0, 2]].sum())),
                *(str(int(n)) for n in counts[name].sum(axis=(0, 2))),
            )
        )
        by_range.append((name, *make_cells(scores[name][:, : len(SHOWN), 2])))
    truth = counts[names[0]][:, [0, 2]].sum(axis=(0, 1))
    lines = tuple(make_line(name, RANGE_MIDDLES, scores[name][:, : len(SHOWN), 2]) for name in names)
    return Section(
        title,
        f"{len(records)} frames with {int(truth.sum())} pedestrians. A hit is a "
        "3D centre within 1.0 m, one to one. Intervals: 95 %, bootstrap over frames.",
        (
            Table(
                f"{key}_variants",
                "All ranges",
                (
                    "variant",
                    "recall [%]",
                    "precision [%]",
                    "F1 [%]",
                    f"F1 above '{names[0]}' [points]",
                    "F1, any threshold [%]",
                    "TP",
                    "FP",
                    "FN",
                ),
                tuple(overall),
                "Any threshold: the best F1 that a threshold chosen on these frames "
                "gives. It compares variants whose scores have different scales.",
            ),
            Table(
                f"{key}_by_range",
                "F1 by range",
                ("variant", *(f"{r} m, n = {int(n)} [%]" for r, n in zip(SHOWN, truth))),
                tuple(by_range),
            ),
        ),
        (Figure(f"{key}_by_range", "F1 by range", (Panel("", "middle of the range [m]", "F1 [%]", lines),)),),
    )


def find_best_f1(ranked: list[list], truth: float) -> float | None:
    """Return the largest F1 over all thresholds, in percent; None without pedestrians."""
    pairs = np.array([pair for frame in ranked for pair in frame], float).reshape(-1, 2)
    if truth == 0:
        return None
    order = np.argsort(-pairs[:, 0], kind="stable")
    hits = np.cumsum(pairs[order, 1])
    last = np.append(np.diff(pairs[order, 0]) != 0, True)[: len(pairs)]  # True at the last pair of each score
    f1 = 2 * hits / (np.arange(1, len(pairs) + 1) + truth)
    return 100 * float(f1[last].max(initial=0.0))


def _compute_gain(sums: np.ndarray) -> np.ndarray:
    """Return F1 of the first less that of the second (...,) of sums (..., 2, 3, 5)."""
    f1 = _compute_scores(sums)[..., -1, 2]
    return f1[..., 0] - f1[..., 1]


def _compute_scores(sums: np.ndarray) -> np.ndarray:
    """Return recall, precision and F1 by range and of all (..., 6, 3) of sums (..., 3, 5)."""
    sums = np.concatenate([sums, sums.sum(axis=-1, keepdims=True)], axis=-1)
    return compute_rates(*np.moveaxis(sums, -2, 0))


CONFIGURATIONS = Experiment(
    "stm-cpa-configurations",
    "STM-CPA: the configurations paper and best",
    "What does `best` gain, with the seed of the paper's protocol and without a labelled seed?",
    measure_frame,
    make_sections,
    {name: flatten(params) for name, params in VARIANTS.items()},
)
