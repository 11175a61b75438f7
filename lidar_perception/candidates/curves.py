"""Log-odds as a sum of one curve per feature, given by its values at a few knots."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np


def compute_log_odds(model: Mapping[str, Any], features: Mapping[str, np.ndarray]) -> np.ndarray:
    """Compute the log-odds (K,) float64 of K objects.

    Args:
        model: `bias`, and `curves` with the `knots` and `values` of each feature. A curve is
            constant beyond its first and last knot. A NaN feature adds the curve's `unknown`, by
            default 0.
        features: arrays (K,) by name.
    """
    odds = np.full(len(next(iter(features.values()))), float(model["bias"]))
    for name, curve in model["curves"].items():
        values = np.interp(features[name], curve["knots"], curve["values"])
        odds += np.where(np.isnan(features[name]), curve.get("unknown", 0.0), values)
    return odds
