"""Log-odds as a sum of curves, one a feature, each given by its values at a few knots."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np


def log_odds(model: Mapping[str, Any], features: Mapping[str, np.ndarray]) -> np.ndarray:
    """(K,) float64 of K things with features (K,), by name. model: `bias`, and by feature its curve
    with `knots` and `values`, level beyond the first and the last; and what NaN counts,
    `unknown`, 0 where there is none."""
    odds = np.full(len(next(iter(features.values()))), float(model["bias"]))
    for name, curve in model["curves"].items():
        values = np.interp(features[name], curve["knots"], curve["values"])
        odds += np.where(np.isnan(features[name]), curve.get("unknown", 0.0), values)
    return odds
