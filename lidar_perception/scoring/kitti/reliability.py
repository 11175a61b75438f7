"""Whether a score is the share of its boxes that are right (Guo et al., ICML 2017), and what makes
it so."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.console import Console
from scipy.special import expit

from lidar_perception.classes import DETECTED
from lidar_perception.scoring.kitti.protocol import SCORED, Comparison, count_hits
from lidar_perception.scoring.tables import make_table

EDGES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)  # scores, where bins begin

LOG_ODDS = np.arange(-7.0, 7.05, 0.1)  # log-odds: finer bins, to which lines are fitted
MIN_BOXES = 10  # of right ones, and of wrong ones, that a line is fitted to


def fit_calibrations(frames: Comparison) -> dict[str, tuple[float, float]]:
    """By class, what detectors/calibration.py makes probabilities of the scores with: logistic
    regression of right and wrong on their log-odds. Classes with too few of either, or whose scores
    say nothing, are left out."""
    from sklearn.linear_model import LogisticRegression
    found, middles = {}, (LOG_ODDS + 0.05)[:, None]
    for name in SCORED:
        hits, wrong = _count_right_and_wrong(frames, name, expit(LOG_ODDS))
        if min(hits.sum(), wrong.sum()) < MIN_BOXES:
            continue
        model = LogisticRegression().fit(
            np.concatenate([middles, middles]), np.repeat([1, 0], len(LOG_ODDS)),
            np.concatenate([hits, wrong]))
        if model.coef_[0, 0] > 0:
            found[name] = round(float(model.coef_[0, 0]), 4), round(float(model.intercept_[0]), 4)
    return found


def _count_right_and_wrong(frames: Comparison, name: str, edges: np.ndarray
                           ) -> tuple[np.ndarray, np.ndarray]:
    """Two (B,): the right and the wrong boxes with scores from each of edges (B,) up to the next,
    from above at the relaxed overlap, hard."""
    hits, wrong = count_hits(frames, name, "bev", DETECTED[name].relaxed, "hard", edges)
    return (np.maximum(-np.diff(np.append(hits, 0.0)), 0.0),
            np.maximum(-np.diff(np.append(wrong, 0.0)), 0.0))


def measure_reliability(frames: Comparison, name: str) -> dict[str, Any]:
    """Of the class called name, hard difficulty, from above at the relaxed overlap: by bin of EDGES
    the number of `boxes` and the percentage `right`, None without boxes; `error`, the mean gap
    between the middle of a bin and the share of its boxes that are right, weighted by boxes, in
    percent. Boxes that KITTI's protocol ignores do not count; a second box of one object is
    wrong."""
    hits, wrong = _count_right_and_wrong(frames, name, np.array(EDGES))
    boxes = hits + wrong
    right = hits / np.maximum(boxes, 1)
    middles = (np.array(EDGES) + np.append(EDGES[1:], 1.0)) / 2
    return {"bins": [{"from": edge, "boxes": int(count),
                      "right": 100 * float(share) if count else None}
                     for edge, count, share in zip(EDGES, boxes, right)],
            "error": 100 * float((boxes * np.abs(right - middles)).sum() / boxes.sum())
            if boxes.any() else None}


def print_reliability(scores: dict[str, dict[str, Any]], console: Console) -> None:
    """One table of all classes."""
    table = make_table("Of the boxes with such a score so many are right, %", "score from",
                       *(f"{edge:g}" for edge in EDGES), "error", width=5)
    for name, content in scores.items():
        table.add_row(name, *("" if row["right"] is None else f"{row['right']:.0f}"
                              for row in content["bins"]),
                      "" if content["error"] is None else f"{content['error']:.0f}")
        table.add_row("  boxes", *(str(row["boxes"]) for row in content["bins"]), style="dim")
    table.caption = ("From above at the relaxed overlap. error: mean gap to the middle of the bin, "
                     "weighted by boxes.")
    console.print(table)
