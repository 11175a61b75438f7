"""Calibration of scores to probabilities: one straight line in log-odds per class (Platt, 1999).

The lines are stored in the header of the weights and fitted to scans outside the training set
(scoring/kitti/reliability.py). Their slopes are positive, so calibration changes neither the order
of the scores nor the average precision.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.special import expit, logit

from lidar_perception.types import CLASSES, Detections

CalibrationLines = Mapping[str, tuple[float, float]]  # class -> (slope > 0, offset), in log-odds


def calibrate_scores(detections: Detections, lines: CalibrationLines) -> Detections:
    """Replace scores by calibrated probabilities; scores of classes without a line do not change."""
    scores = detections.scores.copy()
    for name, (slope, offset) in lines.items():
        is_in_class = detections.class_ids == CLASSES.index(name)
        with np.errstate(divide="ignore"):  # scores 0 and 1 are mapped to themselves
            scores[is_in_class] = expit(slope * logit(scores[is_in_class].astype(np.float64)) + offset)
    return replace(detections, scores=scores)


def to_raw_score(name: str, score: float, lines: CalibrationLines) -> float:
    """Return the raw network score of class `name` that calibration maps to `score`."""
    if name not in lines or score in (0.0, 1.0):
        return score
    slope, offset = lines[name]
    return 1 / (1 + math.exp(min((offset - math.log(score / (1 - score))) / slope, 700.0)))
