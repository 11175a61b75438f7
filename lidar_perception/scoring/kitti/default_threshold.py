"""Precision, recall and F1 of detections at the default threshold."""

from __future__ import annotations

import numpy as np
from rich.console import Console

from lidar_perception.scoring.kitti.protocol import (
    COUNTED,
    RELAXED,
    SCORED,
    ComparedFrame,
    Comparison,
    classify_labels,
    count_hits,
)
from lidar_perception.scoring.tables import format_counts, format_percent, make_table

LEVEL = "moderate"


def score_at_threshold(frames: list[ComparedFrame]) -> dict[str, dict[str, float]]:
    """Score all detections by class (BEV, relaxed overlap, moderate difficulty).

    Returns:
        labels, hits, wrong (false positives), missed, precision, recall and f1 of each class, or {}
        without frames. A ratio with denominator 0 is 0.
    """
    if not frames:
        return {}
    comparison = Comparison.concatenate(frames)
    return {name: _score_class(comparison, name) for name in SCORED}


def _score_class(comparison: Comparison, name: str) -> dict[str, float]:
    hits, false_positives = (
        int(n[0]) for n in count_hits(comparison, name, "bev", RELAXED[name], LEVEL, np.array([-np.inf]))
    )
    labels = int((classify_labels(comparison.labels, name, LEVEL) == COUNTED).sum())
    return {
        "labels": labels,
        "hits": hits,
        "wrong": false_positives,
        "missed": labels - hits,
        "precision": hits / max(hits + false_positives, 1),
        "recall": hits / max(labels, 1),
        "f1": 2 * hits / max(hits + false_positives + labels, 1),
    }


def print_scores_at_threshold(content: dict[str, dict[str, float]], frames: int, console: Console) -> None:
    """Print the result of score_at_threshold for classes with labels or false positives."""
    table = make_table(
        f"Detections at the default threshold, {frames} frames",
        "",
        "overlap",
        "labels",
        "hits",
        "wrong",
        "missed",
        "prec.",
        "recall",
        "F1",
        width=6,
    )
    for name, row in content.items():
        if row["labels"] or row["wrong"]:
            table.add_row(
                name,
                f"{RELAXED[name]:g}",
                *format_counts(row, "labels", "hits", "wrong", "missed"),
                *format_percent(row, "precision", "recall", "f1"),
            )
    table.caption = "BEV, KITTI protocol, moderate difficulty."
    console.print(table)
