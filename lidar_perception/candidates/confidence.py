"""How sure a candidate is: the probability that a cluster is a pedestrian, from its shape and, if
there is a seed, from its likeness to that.

The log-odds are a sum of curves, one a feature, each given by its values at a few knots. They were
fitted to simulated scans alone (scripts/fit_confidence.py); confidence.json holds them.
"""

from __future__ import annotations

import functools
import json
from importlib.resources import files
from typing import Any

import numpy as np
from numba import njit

from lidar_perception.candidates.curves import log_odds
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.silhouette import (
    COLUMNS,
    HEIGHT,
    ROWS,
    WIDTH,
    covered,
    silhouettes,
)
from lidar_perception.param_fields import with_values

SHAPE_KNOTS = {  # feature -> where its curve bends; it is level beyond the first and the last
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
SEED_KNOTS = {"similarity": (0.0, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0),
              "height_difference_m": (0.0, 0.1, 0.2, 0.35, 0.6)}
PIXEL_AREA = HEIGHT / ROWS * WIDTH / COLUMNS  # square metres


def shape_features(xyz: np.ndarray, start: np.ndarray, boxes: np.ndarray,
                   params: PipelineParams = PipelineParams()) -> dict[str, np.ndarray]:
    """The features of SHAPE_KNOTS, each (K,) float64, of K clusters: xyz (N, 3) and start (K + 1,)
    as in silhouette.py, boxes (K, 7) that stand on the ground.

    range_m: of the centroid, horizontal. height_m: of the top above the ground, and half a beam
    step, as the true top is between two beams. length_m, width_m: extent along and across the
    widest direction in x-y. area_m2: points times the surface that each stands for.
    hidden_below_m: from the ground to the lowest point, less a beam step. upright: standard
    deviation of z by the height. fill: drawn part of the rectangle height x length. lopsided:
    between the median and the middle of the extent, by the length.
    """
    stm = {"stm.window": "metric", "stm.spread": True, "stm.dilations": 0, "stm.axis": "yaw"}
    floors = boxes[:, 2].astype(float) - boxes[:, 5] / 2
    drawn = covered(silhouettes(xyz, start, np.ones((len(boxes), 1)), floors,
                                with_values(params, stm))) * PIXEL_AREA
    count = np.diff(start)
    ranges, low, high, spread, length, width, middle = _moments(
        np.ascontiguousarray(xyz, np.float32), np.asarray(start, np.int64)).T
    beam = ranges * np.radians(params.resolution.elevation_step)
    height = np.maximum(high - floors, 0.1)
    return {
        "range_m": ranges,
        "height_m": height + beam / 2,
        "length_m": length,
        "width_m": width,
        "area_m2": count * beam * ranges * np.radians(params.resolution.azimuth_step),
        "hidden_below_m": low - floors - beam,
        "upright": spread / height,
        "fill": drawn / (np.maximum(length, 0.1) * height),
        "lopsided": middle / np.maximum(length, 0.1),
    }


def confidence(shape: dict[str, np.ndarray], similarity: np.ndarray | None = None,
               height_difference: np.ndarray | None = None) -> np.ndarray:
    """(K,) float64 probability 0..1 that each cluster is a pedestrian. With similarity (K,) to a
    seed and height_difference (K,) in metres, from these too. The probability is that of the
    simulated scans, where pedestrians are as far away as in KITTI's labels (paper A, Table 1)."""
    features = dict(shape)
    if similarity is not None and height_difference is not None:
        features.update(similarity=similarity, height_difference_m=np.abs(height_difference))
    model = _models()["shape" if similarity is None else "seed"]
    return 1.0 / (1.0 + np.exp(-log_odds(model, features)))


@functools.cache
def _models() -> dict[str, Any]:
    return json.loads((files("lidar_perception.candidates") / "confidence.json").read_text())


@njit(cache=True)
def _moments(xyz, start):
    """(K, 7): horizontal range of the centroid, lowest and highest z, standard deviation of z,
    extent along and across the widest direction, distance of the median from the middle."""
    out = np.zeros((len(start) - 1, 7))
    for k in range(len(start) - 1):
        points = xyz[start[k]:start[k + 1]].astype(np.float64)
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
        along = points[:, 0] * ax + points[:, 1] * ay
        across = points[:, 1] * ax - points[:, 0] * ay
        middle = (along.max() + along.min()) / 2
        out[k] = (np.hypot(x, y), points[:, 2].min(), points[:, 2].max(), np.sqrt(zz / n),
                  along.max() - along.min(), across.max() - across.min(),
                  abs(np.median(along) - middle))
    return out
