"""Calibration of scores to probabilities: a straight line in the log-odds per class (Platt, 1999).

The header of the weights contains the lines. They are fitted to scans outside the training set
(scoring/kitti/reliability.py). Their slopes are positive, so the order of scores, and with it
average precision, does not change.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.special import expit, logit

from lidar_perception.types import CLASSES, Detections

Lines = Mapping[str, tuple[float, float]]  # class -> (slope > 0, offset), in log-odds


def calibrate_scores(detections: Detections, lines: Lines) -> Detections:
    """Replace scores by calibrated probabilities; scores of classes without a line do not change."""
    scores = detections.scores.copy()
    for name, (slope, offset) in lines.items():
        in_class = detections.class_ids == CLASSES.index(name)
        with np.errstate(divide="ignore"):  # scores 0 and 1 are mapped to themselves
            scores[in_class] = expit(slope * logit(scores[in_class].astype(np.float64)) + offset)
    return replace(detections, scores=scores)


def to_raw_score(name: str, score: float, lines: Lines) -> float:
    """Return the raw network score of class `name` that calibration maps to `score`."""
    if name not in lines or score in (0.0, 1.0):
        return score
    slope, offset = lines[name]
    return 1 / (1 + math.exp(min((offset - math.log(score / (1 - score))) / slope, 700.0)))
