"""Fitting of additive log-odds models, which candidates/confidence.py evaluates."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

PENALTY = 1.0  # weight of the squared steps in the loss; chosen on held-out streets


def compute_ramps(values: np.ndarray, knots: tuple[float, ...]) -> np.ndarray:
    """Return the position (0 .. 1) of values (K,) in each interval between knots: (K, len(knots) - 1), 0 for NaN."""
    low, high = np.array(knots[:-1]), np.array(knots[1:])
    return np.nan_to_num(np.clip((values[:, None] - low) / (high - low), 0.0, 1.0))


def fit_curves(
    features: Mapping[str, np.ndarray],
    hits: np.ndarray,
    weights: np.ndarray,
    knots: Mapping[str, tuple[float, ...]],
    directions: Mapping[str, int] = {},
) -> dict:
    """Fit a piecewise linear curve to each feature by logistic regression on its steps between knots.

    A penalty on the steps keeps curves constant where there are no samples.

    Args:
        features: Values (K,) by name. NaN values have a separate step.
        hits: (K,) bool, the outcomes.
        weights: (K,) weights of the samples.
        knots: Knots of each feature's curve.
        directions: 1 for features whose curve must not fall, -1 for features whose curve must not
            rise.

    Returns:
        The model as JSON data: "bias", and "curves" by feature.
    """
    columns, bounds, widths = [], [], []
    for name, feature_knots in knots.items():
        steps, is_unknown = compute_ramps(features[name], feature_knots), np.isnan(features[name])[:, None]
        direction = directions.get(name, 0)
        columns.append(np.column_stack([steps, is_unknown]) if is_unknown.any() else steps)
        bounds += [{1: (0, None), -1: (None, 0), 0: (None, None)}[direction]] * steps.shape[1]
        bounds += [(None, None)] * int(is_unknown.any())
        widths.append(columns[-1].shape[1])
    design, sign = np.concatenate(columns, axis=1), np.where(hits, 1.0, -1.0)

    def loss(x: np.ndarray) -> tuple[float, np.ndarray]:
        margin = sign * (design @ x[1:] + x[0])
        slope = -weights * sign * expit(-margin)
        return (
            weights @ np.logaddexp(0, -margin) + PENALTY / 2 * x[1:] @ x[1:],
            np.concatenate([[slope.sum()], slope @ design + PENALTY * x[1:]]),
        )

    coefficients = minimize(
        loss,
        np.zeros(design.shape[1] + 1),
        jac=True,
        method="L-BFGS-B",
        bounds=[(None, None), *bounds],
        options={"maxiter": 5000, "maxfun": 10000},
    ).x
    curves: dict[str, dict] = {}
    for (name, feature_knots), steps in zip(knots.items(), np.split(coefficients[1:], np.cumsum(widths)[:-1])):
        curve_steps = steps[: len(feature_knots) - 1]
        curves[name] = {"knots": feature_knots, "values": [0.0, *np.round(np.cumsum(curve_steps), 3).tolist()]}
        if len(steps) > len(curve_steps):
            curves[name]["unknown"] = round(float(steps[-1]), 3)
    return {"bias": round(float(coefficients[0]), 4), "curves": curves}
