"""Precision at given recall, of single frames and of tracks, by centres within 1 m."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lidar_perception.scoring.tracking.pairs import (
    EPS,
    MIN_SIMILARITY,
    Pairs,
    make_pairs,
    to_tracked_labels,
)
from lidar_perception.simulation.camera import FORWARD_CAMERA

if TYPE_CHECKING:
    from benchmark.tracking import Step, TrackedFrame


@dataclass(frozen=True)
class Curve:
    """Scores (K,) and hits (K,) bool of the counted boxes of a drive and class, and its labels."""

    scores: np.ndarray
    hits: np.ndarray
    labels: int


def make_curves(
    drive: list[TrackedFrame], step: Step, classes: tuple[str, ...]
) -> dict[str, Curve]:
    """Make the curve by class; each label belongs to its best matching box."""
    parts: dict[str, list[Curve]] = {name: [] for name in classes}
    for seen in drive:
        ids, found = step(seen)
        pairs = make_pairs(seen.truth, to_tracked_labels(ids, found), FORWARD_CAMERA)
        for name in classes:
            parts[name].append(_of_frame(pairs[name]))
    return {name: Curve(np.concatenate([p.scores for p in own]),
                        np.concatenate([p.hits for p in own]), sum(p.labels for p in own))
            for name, own in parts.items()}


def _of_frame(pairs: Pairs) -> Curve:
    alike = np.where(pairs.similarity >= MIN_SIMILARITY - EPS, pairs.similarity, 0.0)
    counts, hits = np.ones(len(pairs.scores), bool), np.zeros(len(pairs.scores), bool)
    for k in np.argsort(-pairs.scores, kind="stable"):
        row = int(np.argmax(alike[:, k])) if len(alike) else -1
        if row >= 0 and alike[row, k] > 0:
            hits[k], counts[k] = not pairs.ignored[row], not pairs.ignored[row]
            alike[row] = 0.0
        else:
            counts[k] = not pairs.excused[k]
    return Curve(pairs.scores[counts], hits[counts], int((~pairs.ignored).sum()))


def compute_precisions(
    curves: Sequence[Curve], recalls: Sequence[float], draws: np.ndarray
) -> np.ndarray:
    """Return the best precision (D, R) at each of R recalls or above, 0 if not reached.

    draws (D, N) holds how often each of the N drives is drawn.
    """
    order = np.argsort(-np.concatenate([c.scores for c in curves]), kind="stable")
    hit = np.concatenate([c.hits for c in curves])[order]
    drive = np.repeat(np.arange(len(curves)), [len(c.scores) for c in curves])[order]
    labels = draws @ np.array([c.labels for c in curves])
    result = np.zeros((len(draws), len(recalls)))
    for row, times, needed in zip(result, draws, np.outer(labels, recalls)):
        weight = times[drive]
        hits, boxes = np.cumsum(weight * hit), np.cumsum(weight)
        best = np.maximum.accumulate((hits / np.maximum(boxes, 1))[::-1])[::-1]  # from there on
        first = np.searchsorted(hits, np.maximum(needed, 1e-9))
        row[first < len(hits)] = best[first[first < len(hits)]]
    return result
