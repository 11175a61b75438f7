"""What a user gets: the detections of a node or detector as they are, at the scores in use."""

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
    """By class: labels, hits, wrong, missed, and precision, recall and f1, 0 where they have no
    cases; from above, at the relaxed overlap, for what KITTI calls moderate. All detections count,
    whatever their score. Empty without frames."""
    if not frames:
        return {}
    concatenate = Comparison.of(frames)
    return {name: _score_class(concatenate, name) for name in SCORED}


def _score_class(concatenate: Comparison, name: str) -> dict[str, float]:
    every = np.array([-np.inf])
    hits, wrong = (int(n[0]) for n in count_hits(concatenate, name, "bev", RELAXED[name], LEVEL,
                                                 every))
    labels = int((classify_labels(concatenate.true, name, LEVEL) == COUNTED).sum())
    return {"labels": labels, "hits": hits, "wrong": wrong, "missed": labels - hits,
            "precision": hits / max(hits + wrong, 1), "recall": hits / max(labels, 1),
            "f1": 2 * hits / max(hits + wrong + labels, 1)}


def print_scores_at_threshold(
    content: dict[str, dict[str, float]], frames: int, console: Console
) -> None:
    """The table of in_use(); classes that are neither there nor found are left out."""
    table = make_table(f"Detections in use, {frames} frames", "", "overlap", "labels", "hits",
                       "wrong", "missed", "prec.", "recall", "F1", width=6)
    for name, row in content.items():
        if row["labels"] or row["wrong"]:
            table.add_row(name, f"{RELAXED[name]:g}", *format_counts(row, "labels", "hits", "wrong",
                                                                     "missed"),
                          *format_percent(row, "precision", "recall", "f1"))
    table.caption = "From above, by the protocol of KITTI, moderate."
    console.print(table)
