"""Combination of the evidence: per class, a sum of fitted curves of the sources' log-odds.

Sources that see the same object are not independent, so a plain sum would be overconfident. The
curves are fitted jointly, on simulated scans that no source was trained on, so that the sum is a
calibrated probability. fusion.py reads them.
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from lidar_perception.candidates.curves import compute_log_odds
from lidar_perception.detectors.fused.evidence import Evidence
from lidar_perception.detectors.fused.fusion import Models
from lidar_perception.types import CLASSES


def compute_probabilities(models: Models, class_ids: np.ndarray, evidence: Evidence) -> np.ndarray:
    """Return the probability (K,) float32 that each proposal is an object of its class.

    Args:
        class_ids: (K,) indices into CLASSES; a class without a model gets 0.
    """
    result = np.zeros(len(class_ids), np.float32)
    for class_id in np.unique(class_ids):
        own = class_ids == class_id
        if CLASSES[class_id] in models:
            result[own] = expit(compute_log_odds(models[CLASSES[class_id]],
                                                 {source: odds[own] for source,
                                                  odds in evidence.items()}))
    return result


def compute_max_probabilities(models: Models, class_ids: np.ndarray, evidence: Evidence,
                              source: str) -> np.ndarray:
    """Return the highest probability (K,) float32 that each proposal can reach for any evidence of
    `source`.

    A curve is linear between its knots and constant beyond, so its maximum is at a knot or, without
    evidence, its value for unknown.
    """
    best = np.full(len(class_ids), np.nan)
    for class_id in np.unique(class_ids):
        curve = models.get(CLASSES[class_id], {"curves": {}})["curves"].get(source)
        if curve is not None and max(curve["values"]) > curve.get("unknown", 0.0):
            best[class_ids == class_id] = curve["knots"][int(np.argmax(curve["values"]))]
    return compute_probabilities(models, class_ids, {**evidence, source: best})


def compute_source_probabilities(models: Models, class_ids: np.ndarray,
                                 evidence: Evidence) -> dict[str, np.ndarray]:
    """Return, by source, the probability (K,) float32 from this source alone.

    It is NaN where the source gives no evidence, or is not part of the model of the class.
    """
    used_for = {source: [i for i, name in enumerate(CLASSES)
                         if source in models.get(name, {"curves": {}})["curves"]]
                for source in evidence}
    return {source: np.where(np.isin(class_ids, used_for[source]), expit(odds), np.nan).astype(
        np.float32) for source, odds in evidence.items()}

