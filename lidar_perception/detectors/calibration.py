"""Scores as probabilities: by class a straight line through the log-odds (Platt, 1999).

The lines are in the header of the weights, fitted to scans that were not trained on
(scoring/kitti/reliability.py). They rise, so that the order of scores, and with it average
precision, stays as it is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.special import expit, logit

from lidar_perception.types import CLASSES, Detections

Lines = Mapping[str, tuple[float, float]]  # class -> slope, above 0, and offset, of log-odds


def calibrated(detections: Detections, lines: Lines) -> Detections:
    """The detections with scores that are probabilities, in their order; those of a class without
    a line stay as they are."""
    scores = detections.scores.copy()
    for name, (slope, offset) in lines.items():
        own = detections.class_ids == CLASSES.index(name)
        with np.errstate(divide="ignore"):  # of scores 0 and 1, which stay
            scores[own] = expit(slope * logit(scores[own].astype(np.float64)) + offset)
    return replace(detections, scores=scores)


def raw_score(name: str, score: float, lines: Lines) -> float:
    """The inverse for one score: what the network says, of a class, where it is as likely as
    score."""
    if name not in lines or score in (0.0, 1.0):
        return score
    slope, offset = lines[name]
    return 1 / (1 + math.exp(min((offset - math.log(score / (1 - score))) / slope, 700.0)))
