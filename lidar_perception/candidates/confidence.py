"""Confidence of a candidate: the probability that a cluster is a pedestrian.

It depends on the cluster's shape and, if there is a seed, on the similarity to the seed. The
log-odds are the sum of one piecewise linear curve per feature. The curves are in confidence.json;
they were fitted to simulated scans only (scripts/fit_confidence.py).
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from dataclasses import replace
from importlib.resources import files
from typing import Any

import numpy as np
from numba import njit

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.silhouette import (
    COLUMNS,
    ROWS,
    WINDOW_HEIGHT_M,
    WINDOW_WIDTH_M,
    count_pixels,
    draw_silhouettes,
)
from lidar_perception.geometry import quantile

SHAPE_KNOTS = {  # feature -> knots of its curve, which is constant beyond the first and last knot
    "range_m": (5, 10, 15, 20, 30, 40, 55),
    "height_m": (0.8, 1.2, 1.5, 1.65, 1.8, 1.95, 2.1, 2.5),
    "length_m": (0.2, 0.4, 0.6, 0.8, 1.0, 1.3, 2.0),
    "width_m": (0.05, 0.2, 0.35, 0.5, 0.7, 1.0),
    "area_m2": (0.05, 0.15, 0.3, 0.5, 0.8, 1.2, 2.5),
    "hidden_below_m": (0.0, 0.1, 0.3, 0.6, 0.9, 1.3),
    "upright": (0.10, 0.18, 0.24, 0.29, 0.34),
    "fill": (0.1, 0.3, 0.5, 0.7, 0.9, 1.1),
    "lopsided": (0.0, 0.05, 0.12, 0.25),
}
SEED_KNOTS = {"similarity": (0.0, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0), "height_difference_m": (0.0, 0.1, 0.2, 0.35, 0.6)}
PIXEL_AREA_M2 = WINDOW_HEIGHT_M / ROWS * WINDOW_WIDTH_M / COLUMNS


def compute_shape_features(
    xyz: np.ndarray, start: np.ndarray, boxes: np.ndarray, params: PipelineParams = PipelineParams()
) -> dict[str, np.ndarray]:
    """Compute the features in SHAPE_KNOTS for K clusters.

    Args:
        xyz: (N, 3) points, sorted by cluster.
        start: (K + 1,) first row of each cluster, as in silhouette.py.
        boxes: (K, 7) boxes of the clusters, extended down to the ground.

    Returns:
        Arrays (K,) float64 by name:
        range_m: Horizontal range of the centroid.
        height_m: Height of the highest point above the ground plus half the distance between two
            beams, because the actual top is between two beams.
        length_m, width_m: Extents along and across the widest direction in x-y.
        area_m2: Number of points times the surface area per point.
        hidden_below_m: Height of the lowest point above the ground, minus the distance between two
            beams.
        upright: Vertical spread: standard deviation of z divided by the height.
        fill: Filled fraction: area of the silhouette divided by height x length.
        lopsided: Asymmetry along the length: distance of the median from the middle of the extent,
            divided by the length.
    """
    stm = replace(params.stm, window="metric", spread=True, dilations=0, axis="yaw")
    floors = boxes[:, 2].astype(float) - boxes[:, 5] / 2
    silhouette_areas = (
        count_pixels(draw_silhouettes(xyz, start, np.ones((len(boxes), 1)), floors, replace(params, stm=stm)))
        * PIXEL_AREA_M2
    )
    count = np.diff(start)
    ranges, low, high, spread, length, width, median_offset = _compute_moments(
        np.ascontiguousarray(xyz, np.float32), np.asarray(start, np.int64)
    ).T
    beam_steps = ranges * np.radians(params.resolution.elevation_step)
    height = np.maximum(high - floors, 0.1)
    return {
        "range_m": ranges,
        "height_m": height + beam_steps / 2,
        "length_m": length,
        "width_m": width,
        "area_m2": count * beam_steps * ranges * np.radians(params.resolution.azimuth_step),
        "hidden_below_m": low - floors - beam_steps,
        "upright": spread / height,
        "fill": silhouette_areas / (np.maximum(length, 0.1) * height),
        "lopsided": median_offset / np.maximum(length, 0.1),
    }


def compute_confidence(
    shape: dict[str, np.ndarray], similarity: np.ndarray | None = None, height_difference: np.ndarray | None = None
) -> np.ndarray:
    """Compute the probability (K,) float64 that each cluster is a pedestrian.

    The probability is calibrated on simulated scans with the same distribution of pedestrians over
    range as KITTI's labels (paper A, Table 1).

    Args:
        shape: Result of compute_shape_features.
        similarity: (K,) similarity to a seed, or None.
        height_difference: (K,) height difference to the seed, metres; None if `similarity` is None.
    """
    features = dict(shape)
    if similarity is not None and height_difference is not None:
        features.update(similarity=similarity, height_difference_m=np.abs(height_difference))
    model = _load_models()["shape" if similarity is None else "seed"]
    return 1.0 / (1.0 + np.exp(-compute_log_odds(model, features)))


def compute_log_odds(model: Mapping[str, Any], features: Mapping[str, np.ndarray]) -> np.ndarray:
    """Compute the log-odds (K,) float64 of K objects as the sum of a bias and one curve per feature.

    Args:
        model: `bias`, and `curves` with the `knots` and `values` of each feature. Curves are linear
            between knots and constant beyond the first and the last one. For a feature that is NaN,
            the `unknown` value of its curve is added, by default 0.
        features: Arrays (K,) by name.
    """
    log_odds = np.full(len(next(iter(features.values()))), float(model["bias"]))
    for name, curve in model["curves"].items():
        values = np.interp(features[name], curve["knots"], curve["values"])
        log_odds += np.where(np.isnan(features[name]), curve.get("unknown", 0.0), values)
    return log_odds


@functools.cache
def _load_models() -> dict[str, Any]:
    return json.loads((files("lidar_perception.candidates") / "confidence.json").read_text())


@njit(cache=True, nogil=True)
def _compute_moments(xyz, start):
    """Compute seven features of each cluster, (K, 7).

    The columns are the horizontal range of the centroid, the lowest and highest z, the standard
    deviation of z, the extents along and across the widest direction, and the distance between
    median and middle of the extent in this direction.
    """
    moments = np.zeros((len(start) - 1, 7))
    for k in range(len(start) - 1):
        points = xyz[start[k] : start[k + 1]].astype(np.float64)
        n = len(points)
        x, y, z = points[:, 0].mean(), points[:, 1].mean(), points[:, 2].mean()
        xx, xy, yy, zz = 0.0, 0.0, 0.0, 0.0
        for p in points:
            xx += (p[0] - x) ** 2
            xy += (p[0] - x) * (p[1] - y)
            yy += (p[1] - y) ** 2
            zz += (p[2] - z) ** 2
        angle = 0.5 * np.arctan2(2 * xy, xx - yy)
        ax, ay = np.cos(angle), np.sin(angle)
        main_coordinates = points[:, 0] * ax + points[:, 1] * ay
        cross_coordinates = points[:, 1] * ax - points[:, 0] * ay
        middle = (main_coordinates.max() + main_coordinates.min()) / 2
        moments[k] = (
            np.hypot(x, y),
            points[:, 2].min(),
            points[:, 2].max(),
            np.sqrt(zz / n),
            main_coordinates.max() - main_coordinates.min(),
            cross_coordinates.max() - cross_coordinates.min(),
            abs(quantile(main_coordinates.copy(), 0.5) - middle),
        )
    return moments
