"""Reliability of scores as probabilities (Guo et al., ICML 2017), and their calibration."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.console import Console
from scipy.special import expit

from lidar_perception.classes import DETECTED
from lidar_perception.scoring.kitti.protocol import SCORED, Comparison, count_hits
from lidar_perception.scoring.tables import make_table

EDGES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)  # lower edges of the bins of scores

LOG_ODDS = np.arange(-7.0, 7.05, 0.1)  # finer bins for the fit
MIN_BOXES = 10  # minimum number of correct and of wrong boxes for a fit


def fit_calibrations(frames: Comparison) -> dict[str, tuple[float, float]]:
    """Fit the calibration of detectors/calibration.py by class.

    It is a logistic regression of right and wrong boxes on the log odds of their scores. Classes
    with fewer than MIN_BOXES of either, or whose scores are not informative, are left out.
    """
    from sklearn.linear_model import LogisticRegression

    found, middles = {}, (LOG_ODDS + 0.05)[:, None]
    for name in SCORED:
        hits, wrong = _count_right_and_wrong(frames, name, expit(LOG_ODDS))
        if min(hits.sum(), wrong.sum()) < MIN_BOXES:
            continue
        model = LogisticRegression().fit(
            np.concatenate([middles, middles]), np.repeat([1, 0], len(LOG_ODDS)), np.concatenate([hits, wrong])
        )
        if model.coef_[0, 0] > 0:
            found[name] = round(float(model.coef_[0, 0]), 4), round(float(model.intercept_[0]), 4)
    return found


def _count_right_and_wrong(frames: Comparison, name: str, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Count right and wrong boxes (B,) with scores between edges (B,); BEV, relaxed, hard."""
    hits, wrong = count_hits(frames, name, "bev", DETECTED[name].relaxed, "hard", edges)
    return (np.maximum(-np.diff(np.append(hits, 0.0)), 0.0), np.maximum(-np.diff(np.append(wrong, 0.0)), 0.0))


def measure_reliability(frames: Comparison, name: str) -> dict[str, Any]:
    """Measure the reliability of the scores of a class (hard difficulty, BEV, relaxed overlap).

    Boxes that KITTI's protocol ignores do not count; a second box of one object is wrong.

    Returns:
        bins: by bin of EDGES the number of `boxes` and the percentage `right`, None without boxes.
        error: mean gap between the middle of a bin and its share of right boxes, weighted by boxes,
            in percent.
    """
    hits, wrong = _count_right_and_wrong(frames, name, np.array(EDGES))
    boxes = hits + wrong
    right = hits / np.maximum(boxes, 1)
    middles = (np.array(EDGES) + np.append(EDGES[1:], 1.0)) / 2
    return {
        "bins": [
            {"from": edge, "boxes": int(count), "right": 100 * float(share) if count else None}
            for edge, count, share in zip(EDGES, boxes, right)
        ],
        "error": 100 * float((boxes * np.abs(right - middles)).sum() / boxes.sum()) if boxes.any() else None,
    }


def print_reliability(scores: dict[str, dict[str, Any]], console: Console) -> None:
    """Print one table of all classes."""
    table = make_table("Right boxes by score, %", "score from", *(f"{edge:g}" for edge in EDGES), "error", width=5)
    for name, content in scores.items():
        table.add_row(
            name,
            *("" if row["right"] is None else f"{row['right']:.0f}" for row in content["bins"]),
            "" if content["error"] is None else f"{content['error']:.0f}",
        )
        table.add_row("  boxes", *(str(row["boxes"]) for row in content["bins"]), style="dim")
    table.caption = "BEV at the relaxed overlap. error: mean gap to the middle of the bin, weighted by boxes."
    console.print(table)
