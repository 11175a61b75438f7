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

LOG_ODDS = np.arange(-7.0, 7.05, 0.1)  # lower edges of the finer bins for the fit, as log odds
MIN_BOXES = 10  # minimum number of true positives, and of false positives, for a fit


def fit_calibrations(frames: Comparison) -> dict[str, tuple[float, float]]:
    """Fit the score calibration of each class; see detectors/calibration.py.

    The fit is a logistic regression on the log odds of the scores: true against false positives.
    Classes with fewer than MIN_BOXES true or false positives, or with uninformative scores, are left
    out.
    """
    from sklearn.linear_model import LogisticRegression

    calibrations, bin_centres = {}, (LOG_ODDS + 0.05)[:, None]
    for name in SCORED:
        hits, false_positives = _count_by_score(frames, name, expit(LOG_ODDS))
        if min(hits.sum(), false_positives.sum()) < MIN_BOXES:
            continue
        model = LogisticRegression().fit(
            np.concatenate([bin_centres, bin_centres]),
            np.repeat([1, 0], len(LOG_ODDS)),
            np.concatenate([hits, false_positives]),
        )
        if model.coef_[0, 0] > 0:
            calibrations[name] = round(float(model.coef_[0, 0]), 4), round(float(model.intercept_[0]), 4)
    return calibrations


def _count_by_score(frames: Comparison, name: str, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Count true and false positives, (B,) each, in bins of the score with lower edges (B,).

    Matches are in BEV at the relaxed overlap, with hard difficulty.
    """
    hits, false_positives = count_hits(frames, name, "bev", DETECTED[name].relaxed, "hard", edges)
    return (np.maximum(-np.diff(np.append(hits, 0.0)), 0.0), np.maximum(-np.diff(np.append(false_positives, 0.0)), 0.0))


def measure_reliability(frames: Comparison, name: str) -> dict[str, Any]:
    """Measure the reliability of the scores of a class (hard difficulty, BEV, relaxed overlap).

    Boxes that KITTI's protocol ignores are not counted. Duplicate boxes are false positives.

    Returns:
        bins: For each bin of EDGES, the number of `boxes` and the percentage of true positives
            (`right`, None without boxes).
        error: Expected calibration error in percent: the mean gap between the centre of a bin and
            its fraction of true positives, weighted by the number of boxes.
    """
    hits, false_positives = _count_by_score(frames, name, np.array(EDGES))
    boxes = hits + false_positives
    precision = hits / np.maximum(boxes, 1)
    bin_centres = (np.array(EDGES) + np.append(EDGES[1:], 1.0)) / 2
    return {
        "bins": [
            {"from": edge, "boxes": int(count), "right": 100 * float(fraction) if count else None}
            for edge, count, fraction in zip(EDGES, boxes, precision)
        ],
        "error": 100 * float((boxes * np.abs(precision - bin_centres)).sum() / boxes.sum()) if boxes.any() else None,
    }


def print_reliability(scores: dict[str, dict[str, Any]], console: Console) -> None:
    """Print one table with the reliability of all classes."""
    table = make_table("True positives by score, %", "score from", *(f"{edge:g}" for edge in EDGES), "error", width=5)
    for name, content in scores.items():
        table.add_row(
            name,
            *("" if row["right"] is None else f"{row['right']:.0f}" for row in content["bins"]),
            "" if content["error"] is None else f"{content['error']:.0f}",
        )
        table.add_row("  boxes", *(str(row["boxes"]) for row in content["bins"]), style="dim")
    table.caption = "BEV at the relaxed overlap. error: mean difference from the middle of the bin, weighted by boxes."
    console.print(table)
