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
from lidar_perception.candidates.seeds import Seed, load_seeds
from lidar_perception.candidates.segmented_cloud import SegmentedCloud
from lidar_perception.data.frame import Frame
from lidar_perception.detectors.automatic_seed import make_automatic_source
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
SHOWN_RANGES = RANGE_NAMES[:4]  # there are hardly any pedestrians beyond 60 m
RANGE_CENTRES = (7.5, 22.5, 37.5, 52.5)  # centres of SHOWN_RANGES, metres
COUNTS = ("tp", "fp", "fn")
ANY_SCORE = {"stm.threshold": 0.0, "confidence.threshold": 0.0}


class ScoredBoxes(NamedTuple):
    """All candidates, before the score threshold is applied.

    Attributes:
        boxes: (K, 7).
        scores: (K,).
        threshold: Minimum score to accept a candidate.
    """

    boxes: np.ndarray
    scores: np.ndarray
    threshold: float

    @property
    def accepted_boxes(self) -> np.ndarray:
        """Boxes (A, 7) whose score reaches the threshold."""
        return self.boxes[self.scores >= self.threshold]


def measure_frame(frames: Sequence[Frame], number: int) -> dict[str, Any]:
    """Measure frame `number`. In the record, `variants` has the result of score_boxes() by variant."""
    labelled = load_labelled_frame(frames[number])
    segment = _make_cached_segment(labelled)
    candidates = {name: _find_candidates(segment(params), labelled, params) for name, params in VARIANTS.items()}
    truth = labelled.pedestrians
    variants = {name: score_boxes(boxes, truth) for name, boxes in candidates.items()}
    for name, source in WITHOUT_SEED.items():
        variants[name] = score_boxes(*drop_seed_pedestrian(candidates[source], truth, find_nearest(truth)))
    return {"frame": frames[number].name, "variants": variants}


def drop_seed_pedestrian(
    candidates: ScoredBoxes, truth: np.ndarray, seed_box: np.ndarray
) -> tuple[ScoredBoxes, np.ndarray]:
    """Drop the seed pedestrian (7,) from the true boxes (M, 7), and the candidate that matches it."""
    indices, _ = match_centres(candidates.boxes, seed_box[None])
    return (
        ScoredBoxes(
            np.delete(candidates.boxes, indices, axis=0), np.delete(candidates.scores, indices), candidates.threshold
        ),
        truth[(truth != seed_box).any(axis=1)],
    )


def score_boxes(candidates: ScoredBoxes, truth: np.ndarray) -> dict[str, list]:
    """Match candidates with true boxes (M, 7).

    Returns:
        `tp`, `fp` and `fn` of the accepted boxes, with one value per range in RANGE_NAMES; and
        `ranked`, with [score, 1 for a hit or 0] of every candidate. For `ranked`, candidates are
        matched regardless of their scores, so that each pedestrian has at most one hit.
    """
    boxes = candidates.accepted_boxes
    counts = count_by_range(boxes, truth, match_centres(boxes, truth))
    is_hit = np.isin(np.arange(len(candidates.boxes)), match_centres(candidates.boxes, truth)[0])
    return {
        **{name: count.tolist() for name, count in zip(COUNTS, counts)},
        "ranked": [[round(float(score), 4), int(hit)] for score, hit in zip(candidates.scores, is_hit)],
    }


def _make_cached_segment(labelled: LabelledFrame) -> Callable[[PipelineParams], SegmentedCloud]:
    """Return a function that segments the frame, and only once for equal parameters."""
    cache: dict[tuple, SegmentedCloud] = {}

    def segment(params: PipelineParams) -> SegmentedCloud:
        key = (params.view, params.ground, params.clustering, params.boxes)
        if key not in cache:
            cache[key] = labelled.segment(params)
        return cache[key]

    return segment


def _find_candidates(segmented: SegmentedCloud, labelled: LabelledFrame, params: PipelineParams) -> ScoredBoxes:
    """Return all candidates of the last stage; none if there is no seed."""

    def make_seeds(_: SegmentedCloud) -> tuple[Seed, ...]:
        if params.seed.source == "ground_truth":
            return (make_nearest_seed(segmented, labelled),)
        templates = load_seeds(params.seed.file)
        if params.seed.source == "automatic":
            return make_automatic_source(params.seed)(segmented)
        return templates

    stage = params.confidence if params.confidence.enabled else params.stm
    try:
        candidates = refine_segmented(segmented, make_seeds, with_values(params, ANY_SCORE)).final
    except InputError:
        return ScoredBoxes(np.zeros((0, 7), np.float32), np.zeros(0), 0.0)
    return ScoredBoxes(candidates.boxes, candidates.scores, stage.threshold)


def make_sections(records: list[dict[str, Any]]) -> list[Section]:
    """Make the report: all variants, and those without the seed pedestrian."""
    records = [record["variants"] for record in records if "skipped" not in record]
    return [
        _make_section("Configurations", tuple(VARIANTS), records, "all"),
        _make_section("Without the seed pedestrian", tuple(WITHOUT_SEED), records, "without_seed"),
    ]


def _make_section(title: str, names: Sequence[str], records: list[dict[str, Any]], key: str) -> Section:
    """Return a section with the scores of each variant, the gain over the first one, and F1 by range.

    Args:
        title: Title of the section.
        names: Names of the variants, the reference first.
        records: Result of score_boxes() by variant, for each frame.
        key: Prefix of the table names.
    """
    counts = {
        name: stack_counts([[r[name][k] for k in COUNTS] for r in records], 3, len(RANGE_NAMES)) for name in names
    }
    scores = {name: bootstrap(c, _compute_scores) for name, c in counts.items()}
    total_rows: list[Row] = []
    range_rows: list[Row] = []
    for name in names:
        paired_counts = np.stack([counts[name], counts[names[0]]], axis=1)
        gain = bootstrap(paired_counts, _compute_gain)[:, None]
        total_rows.append(
            (
                name,
                *make_cells(scores[name][:, -1]),
                *(make_cells(gain) if name != names[0] else ("",)),
                Cell(find_best_f1([r[name]["ranked"] for r in records], counts[name][:, [0, 2]].sum())),
                *(str(int(n)) for n in counts[name].sum(axis=(0, 2))),
            )
        )
        range_rows.append((name, *make_cells(scores[name][:, : len(SHOWN_RANGES), 2])))
    label_counts = counts[names[0]][:, [0, 2]].sum(axis=(0, 1))
    lines = tuple(make_line(name, RANGE_CENTRES, scores[name][:, : len(SHOWN_RANGES), 2]) for name in names)
    return Section(
        title,
        f"{len(records)} frames with {int(label_counts.sum())} pedestrians. A hit has its "
        "3D centre within 1.0 m of the label, one to one. Intervals: 95 %, bootstrap over frames.",
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
                tuple(total_rows),
                "Any threshold: the best F1 over all thresholds, chosen on these "
                "frames. It compares variants whose scores have different scales.",
            ),
            Table(
                f"{key}_by_range",
                "F1 by range",
                ("variant", *(f"{r} m, n = {int(n)} [%]" for r, n in zip(SHOWN_RANGES, label_counts))),
                tuple(range_rows),
            ),
        ),
        (Figure(f"{key}_by_range", "F1 by range", (Panel("", "middle of the range [m]", "F1 [%]", lines),)),),
    )


def find_best_f1(ranked_candidates: list[list], label_count: float) -> float | None:
    """Return the best F1 over all thresholds, in percent; None if there are no pedestrians.

    Args:
        ranked_candidates: `ranked` of score_boxes() for each frame.
        label_count: Number of labelled pedestrians.
    """
    pairs = np.array([pair for frame in ranked_candidates for pair in frame], float).reshape(-1, 2)
    if label_count == 0:
        return None
    order = np.argsort(-pairs[:, 0], kind="stable")
    hits = np.cumsum(pairs[order, 1])
    is_last = np.append(np.diff(pairs[order, 0]) != 0, True)[: len(pairs)]  # True at the last pair of each score
    f1 = 2 * hits / (np.arange(1, len(pairs) + 1) + label_count)
    return 100 * float(f1[is_last].max(initial=0.0))


def _compute_gain(sums: np.ndarray) -> np.ndarray:
    """Compute the F1 of the first variant minus that of the second (...,) from sums (..., 2, 3, 5)."""
    f1 = _compute_scores(sums)[..., -1, 2]
    return f1[..., 0] - f1[..., 1]


def _compute_scores(sums: np.ndarray) -> np.ndarray:
    """Compute recall, precision and F1 by range and in total (..., 6, 3) from sums (..., 3, 5)."""
    sums = np.concatenate([sums, sums.sum(axis=-1, keepdims=True)], axis=-1)
    return compute_rates(*np.moveaxis(sums, -2, 0))


CONFIGURATIONS = Experiment(
    "stm-cpa-configurations",
    "STM-CPA: the configurations paper and best",
    "How much better is `best`, with the seed of the paper's protocol and without a labelled seed?",
    measure_frame,
    make_sections,
    {name: flatten(params) for name, params in VARIANTS.items()},
)
