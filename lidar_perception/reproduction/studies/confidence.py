"""Question 4: a score for each candidate, so that precision and recall make a curve; and whether
it means what it says."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from sklearn.calibration import calibration_curve
from sklearn.metrics import precision_recall_curve

from lidar_perception.candidates.confidence import compute_confidence, compute_shape_features
from lidar_perception.candidates.configurations import BEST, PAPER
from lidar_perception.candidates.pipeline import refine_segmented
from lidar_perception.data.frame import Frame
from lidar_perception.groups import group_points
from lidar_perception.param_fields import flatten, with_values
from lidar_perception.reproduction.experiment import (
    Cell,
    Experiment,
    Figure,
    Line,
    Panel,
    Row,
    Section,
    Table,
)
from lidar_perception.reproduction.labelled import load_labelled, nearest_seed
from lidar_perception.reproduction.params import BootstrapParams
from lidar_perception.reproduction.statistics import cells
from lidar_perception.reproduction.variants import ANY_SCORE, ranked, segments_of
from lidar_perception.types import Detections, InputError

SCORES = {
    "similarity, paper": with_values(PAPER, ANY_SCORE),
    "similarity, best drawing": with_values(BEST, {**ANY_SCORE, "confidence.enabled": False}),
    "confidence": with_values(BEST, ANY_SCORE),
}
SHAPE = "confidence without a seed"
NAMES = (*SCORES, SHAPE)
BINS = np.linspace(0, 1, 11)


def measure(frames: Sequence[Frame], number: int) -> dict[str, Any]:
    """The record: pedestrians, how many; scored: name -> [score, 1 hit | 0] of each candidate. A
    hit is decided before the scores: each pedestrian has at most one candidate."""
    labelled = load_labelled(frames[number])
    segments, truth = segments_of(labelled), labelled.pedestrians
    scored = {}
    for name, params in SCORES.items():
        try:
            found = refine_segmented(segments(params), lambda s: nearest_seed(s, labelled),
                                     params).final
        except InputError:
            found = Detections.none()
        scored[name] = ranked(found.boxes, found.scores, truth)
    s = segments(BEST)
    everything = np.arange(1, len(s.boxes) + 1)
    shape = compute_shape_features(*group_points(s.xyz, s.cluster_ids, everything), s.boxes, BEST)
    scored[SHAPE] = ranked(s.boxes, compute_confidence(shape), truth)
    return {"frame": frames[number].name, "pedestrians": len(truth), "scored": scored}


def sections(records: list[dict[str, Any]]) -> list[Section]:
    """The report: ranking by each score, and calibration of the confidences."""
    records = [r for r in records if "skipped" not in r]
    truth = np.array([r["pedestrians"] for r in records], float)
    rows: list[Row] = []
    calibration: list[Row] = []
    curves, lines = [], []
    for name in NAMES:
        scores, hits, frame = _flat([r["scored"][name] for r in records])
        estimates = _intervals(scores, hits, frame, truth)
        rows.append((name, *cells(estimates), str(int(hits.sum())), str(len(hits))))
        precision, recall = precision_recall(scores, hits, truth.sum())
        curves.append(Line(name, tuple(100 * recall), tuple(100 * precision)))
        if name.startswith("confidence"):
            bins = reliability(scores, hits)
            calibration += [(name, f"{BINS[k]:.1f}-{BINS[k + 1]:.1f}", *(
                Cell(None if v is None else 100 * v) for v in row[:2]), str(row[2]))
                for k, row in enumerate(bins)]
            known = [row for row in bins if row[2]]
            lines.append(Line(name, tuple(100 * row[0] for row in known),
                              tuple(100 * row[1] for row in known)))
    lines.append(Line("what it should be", (0, 100), (0, 100), dashed=True))
    return [
        Section("A score for each candidate",
                f"{len(records)} frames with {int(truth.sum())} pedestrians. AP is the area under "
                "the curve of precision over recall at a centre distance of 1.0 m; best F1 is over "
                "all thresholds.",
                (Table("average_precision", "Ranking", ("score", "AP [%]", "best F1 [%]", "hits",
                                                        "candidates"), tuple(rows)),),
                (Figure("precision_recall", "Precision over recall",
                        (Panel("", "recall [%]", "precision [%]", tuple(curves)),)),)),
        Section("Calibration", "Candidates by confidence: the mean of what they claim, and the "
                "share that is a pedestrian.",
                (Table("calibration", "Claimed and true", ("score", "bin", "claimed [%]",
                                                           "true [%]", "candidates"),
                       tuple(calibration)),),
                (Figure("calibration", "Calibration",
                        (Panel("", "claimed [%]", "true [%]", tuple(lines)),)),))]


def precision_recall(scores: np.ndarray, hits: np.ndarray,
                     truth: float) -> tuple[np.ndarray, np.ndarray]:
    """Precision and recall (D,) at each of the D scores that there are, the highest first; hits
    (N,) 0 | 1 of candidates with scores (N,), truth pedestrians."""
    if not hits.any():
        return np.zeros(0), np.zeros(0)
    precision, recall, _ = precision_recall_curve(hits, scores)
    return precision[-2::-1], recall[-2::-1] * hits.sum() / truth  # of all, not of those found


def reliability(scores: np.ndarray, hits: np.ndarray) -> list[tuple]:
    """(mean score, share of hits, candidates) for each of BINS; None where there are none."""
    if len(scores) == 0:
        return [(None, None, 0)] * (len(BINS) - 1)
    true, claimed = calibration_curve(hits, scores, n_bins=len(BINS) - 1)
    count = np.bincount(np.searchsorted(BINS[1:-1], scores), minlength=len(BINS) - 1)
    rows = zip(claimed.tolist(), true.tolist())  # of bins with candidates
    return [(*next(rows), int(n)) if n else (None, None, 0) for n in count]


def _flat(frames: list[list]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rows = [(*pair, i) for i, pairs in enumerate(frames) for pair in pairs]
    scores, hits, frame = np.array(rows, float).reshape(-1, 3).T
    return scores, hits, frame.astype(int)


def _intervals(scores: np.ndarray, hits: np.ndarray, frame: np.ndarray, truth: np.ndarray,
               params: BootstrapParams = BootstrapParams()) -> np.ndarray:
    """(3, 2) AP and best F1 in percent with the ends of their intervals, frames drawn anew."""
    if len(truth) == 0 or truth.sum() == 0 or len(scores) == 0:
        return np.full((3, 2), np.nan)
    order = np.argsort(-scores, kind="stable")
    hits, frame = hits[order], frame[order]
    last = np.append(np.diff(scores[order]) != 0, True)  # equal scores are accepted together

    def figures(weight: np.ndarray) -> tuple[float, float]:
        tp, all_found, everyone = np.cumsum(weight[frame] * hits), np.cumsum(weight[frame]), \
            weight @ truth
        tp, all_found = tp[last], all_found[last]
        precision = np.divide(tp, all_found, out=np.zeros(len(tp)), where=all_found > 0)
        f1 = 2 * tp / np.maximum(all_found + everyone, 1e-9)
        return (100 * float(np.diff(tp, prepend=0.0) @ precision) / max(everyone, 1e-9),
                100 * float(f1.max()))

    rng, count = np.random.default_rng(params.seed), len(truth)
    drawn = np.array([figures(np.bincount(rng.integers(count, size=count), minlength=count)
                              .astype(float)) for _ in range(params.replicates)])
    ends = np.percentile(drawn, [50 - 50 * params.level, 50 + 50 * params.level], axis=0)
    return np.stack([figures(np.ones(count)), *ends])


STUDY = Experiment("confidence", "Confidence of candidates",
                   "Which score ranks candidates best, and does the confidence mean what it says?",
                   measure, sections, {"paper": flatten(PAPER), "best": flatten(BEST)})
