"""Anchor boxes: one per class and yaw in every cell of the head's feature map."""

from __future__ import annotations

import numpy as np

from lidar_perception.detectors.pointpillars.config import NetworkConfig


def make_anchors(config: NetworkConfig) -> np.ndarray:
    """Return all anchors (A, 7) float32 [x y z l w h yaw].

    A = H * W * classes * yaws, in this order, with (H, W) = config.head_grid and rows along y.
    """
    height, width = config.head_grid
    x, y = (_centres(config.low[axis], config.high[axis], count, config.anchors_at)
            for axis, count in ((0, width), (1, height)))
    of_cell = [[a.z, *a.size, yaw] for a in config.anchors for yaw in config.yaws]
    anchors = np.empty((height, width, len(of_cell), 7), np.float32)
    anchors[..., 0] = x[None, :, None]
    anchors[..., 1] = y[:, None, None]
    anchors[..., 2:] = of_cell
    return anchors.reshape(-1, 7)


def anchor_classes(config: NetworkConfig) -> np.ndarray:
    """Return the class of each anchor, (A,) int64 indices into config.classes."""
    height, width = config.head_grid
    return np.tile(np.repeat(np.arange(len(config.anchors)), len(config.yaws)), height * width)


def _centres(low: float, high: float, count: int, at: str) -> np.ndarray:
    if at == "ends":
        return np.linspace(low, high, count, dtype=np.float32)
    return low + (np.arange(count, dtype=np.float32) + 0.5) * ((high - low) / count)
