"""How much each source counts: by class, the log-odds of the sources summed along fitted curves.

Two sources that see the same thing are not independent, so a plain sum would be too sure. The
curves were fitted together, to simulated scans that no source was trained on, so that the sum is
the probability there; fusion.py reads them.
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from lidar_perception.candidates.curves import compute_log_odds
from lidar_perception.detectors.fused.evidence import Evidence
from lidar_perception.detectors.fused.fusion import Models
from lidar_perception.types import CLASSES


def probabilities(models: Models, class_ids: np.ndarray, evidence: Evidence) -> np.ndarray:
    """(K,) float32, 0..1, that each of K proposals is of its class, class_ids (K,) into CLASSES; 0
    for a class that nothing was fitted for."""
    result = np.zeros(len(class_ids), np.float32)
    for class_id in np.unique(class_ids):
        own = class_ids == class_id
        if CLASSES[class_id] in models:
            result[own] = expit(compute_log_odds(models[CLASSES[class_id]],
                                                 {source: odds[own] for source,
                                                  odds in evidence.items()}))
    return result


def at_most(models: Models, class_ids: np.ndarray, evidence: Evidence,
            source: str) -> np.ndarray:
    """(K,) float32: the greatest probability that each of K proposals can have, whatever one more
    source will say."""
    count = len(class_ids)
    return np.maximum(*(probabilities(models, class_ids, {**evidence, source: np.full(count, said)})
                        for said in (np.inf, np.nan)))


def sources(models: Models, class_ids: np.ndarray,
            evidence: Evidence) -> dict[str, np.ndarray]:
    """By source, the probability (K,) float32 that it alone gives each of K proposals; NaN where it
    says nothing, or does not count for the class."""
    counts = {source: [i for i, name in enumerate(CLASSES)
                       if source in models.get(name, {"curves": {}})["curves"]]
              for source in evidence}
    return {source: np.where(np.isin(class_ids, counts[source]), expit(odds), np.nan).astype(
        np.float32) for source, odds in evidence.items()}

