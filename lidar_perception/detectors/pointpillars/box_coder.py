"""Decoding of network outputs relative to anchors (SECOND, Yan et al. 2018).

Yaw is encoded modulo pi; the half of the circle is a separate bin. targets.py has the inverse.
"""

from __future__ import annotations

import math

import numpy as np


def decode(codes: np.ndarray, bins: np.ndarray, anchors: np.ndarray, offset: float) -> np.ndarray:
    """Decode boxes (N, 7) float32 [x y z l w h yaw], yaw in [-pi, pi).

    The angle in `codes` gives the axis of a box, `bins` the direction along it. Sizes are limited
    to e^4 times the anchor's.

    Args:
        codes: (N, 7) float32.
        bins: (N,) 0 or 1.
        anchors: (N, 7).
        offset: start of the bins, radians.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # broken weights are reported elsewhere
        diagonal = np.hypot(anchors[:, 3], anchors[:, 4])
        line = codes[:, 6] + anchors[:, 6] - offset
        yaw = line - np.floor(line / math.pi) * math.pi + offset + math.pi * bins.astype(line.dtype)
        return np.column_stack([
            codes[:, 0] * diagonal + anchors[:, 0],
            codes[:, 1] * diagonal + anchors[:, 1],
            codes[:, 2] * anchors[:, 5] + anchors[:, 2],
            np.exp(np.minimum(codes[:, 3:6], 4.0)) * anchors[:, 3:6],
            np.remainder(yaw + math.pi, 2 * math.pi) - math.pi])
