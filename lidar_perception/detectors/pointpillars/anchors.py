"""Anchor boxes, and decoding of network outputs relative to them (SECOND, Yan et al. 2018).

Each cell of the head's feature map has one anchor per class and yaw. Yaw is encoded modulo pi, and
a separate bin distinguishes the two directions. The encoding is in targets.py.
"""

from __future__ import annotations

import math

import numpy as np

from lidar_perception.detectors.pointpillars.config import NetworkConfig


def make_anchors(config: NetworkConfig) -> np.ndarray:
    """Make all anchors (A, 7) float32 [x y z l w h yaw].

    They are ordered by row, column, class and yaw, where rows are along y; see config.head_grid.
    """
    height, width = config.head_grid
    x, y = (
        _place_centres(config.low[axis], config.high[axis], count, config.anchors_at)
        for axis, count in ((0, width), (1, height))
    )
    cell_anchors = [[a.z, *a.size, yaw] for a in config.anchors for yaw in config.yaws]
    anchors = np.empty((height, width, len(cell_anchors), 7), np.float32)
    anchors[..., 0] = x[None, :, None]
    anchors[..., 1] = y[:, None, None]
    anchors[..., 2:] = cell_anchors
    return anchors.reshape(-1, 7)


def get_anchor_classes(config: NetworkConfig) -> np.ndarray:
    """Return the class of each anchor, (A,) int64 indices into config.classes."""
    height, width = config.head_grid
    return np.tile(np.repeat(np.arange(len(config.anchors)), len(config.yaws)), height * width)


def _place_centres(low: float, high: float, count: int, placement: str) -> np.ndarray:
    if placement == "ends":
        return np.linspace(low, high, count, dtype=np.float32)
    return low + (np.arange(count, dtype=np.float32) + 0.5) * ((high - low) / count)


def decode(codes: np.ndarray, bins: np.ndarray, anchors: np.ndarray, offset: float) -> np.ndarray:
    """Decode boxes (N, 7) float32 [x y z l w h yaw], yaw in [-pi, pi).

    The angle in `codes` gives the axis of a box, and `bins` the direction along it. Sizes are
    limited to e^4 times those of the anchor.

    Args:
        codes: (N, 7) float32.
        bins: (N,) 0 or 1.
        anchors: (N, 7).
        offset: start of the bins, radians.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # broken weights are reported elsewhere
        diagonal = np.hypot(anchors[:, 3], anchors[:, 4])
        axis_yaw = codes[:, 6] + anchors[:, 6] - offset
        yaw = axis_yaw - np.floor(axis_yaw / math.pi) * math.pi + offset + math.pi * bins.astype(axis_yaw.dtype)
        return np.column_stack(
            [
                codes[:, 0] * diagonal + anchors[:, 0],
                codes[:, 1] * diagonal + anchors[:, 1],
                codes[:, 2] * anchors[:, 5] + anchors[:, 2],
                np.exp(np.minimum(codes[:, 3:6], 4.0)) * anchors[:, 3:6],
                np.remainder(yaw + math.pi, 2 * math.pi) - math.pi,
            ]
        )
