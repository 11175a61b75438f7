"""Boxes from what the network predicts relative to an anchor (SECOND, Yan et al. 2018).

The angle is coded without its direction, which half of the circle it lies in: that is a bin of its
own. targets.py has the inverse.
"""

from __future__ import annotations

import math

import numpy as np


def decode(codes: np.ndarray, bins: np.ndarray, anchors: np.ndarray, offset: float) -> np.ndarray:
    """Return (N, 7) float32 boxes [x y z l w h yaw], yaw in [-pi, pi), of codes (N, 7) float32 and
    bins (N,) relative to anchors (N, 7). Of the angle in codes only the line counts, bins say its
    direction. Sizes are at most e^4 times the anchor's."""
    with np.errstate(over="ignore", invalid="ignore"):  # of broken weights, which are reported
        diagonal = np.hypot(anchors[:, 3], anchors[:, 4])
        line = codes[:, 6] + anchors[:, 6] - offset
        yaw = line - np.floor(line / math.pi) * math.pi + offset + math.pi * bins.astype(line.dtype)
        return np.column_stack([
            codes[:, 0] * diagonal + anchors[:, 0],
            codes[:, 1] * diagonal + anchors[:, 1],
            codes[:, 2] * anchors[:, 5] + anchors[:, 2],
            np.exp(np.minimum(codes[:, 3:6], 4.0)) * anchors[:, 3:6],
            np.remainder(yaw + math.pi, 2 * math.pi) - math.pi])
