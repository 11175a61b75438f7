"""Anchor boxes: one of each class and yaw in every cell of the head's feature map."""

from __future__ import annotations

import torch
from torch import Tensor

from lidar_perception.detectors.pointpillars.config import NetworkConfig


def make_anchors(config: NetworkConfig, device: str | torch.device = "cpu") -> Tensor:
    """(A, 7) float32 [x y z l w h yaw], A = H * W * classes * yaws, in this order; H and W of
    config.head_grid, rows along y."""
    height, width = config.head_grid
    x, y = (_centres(config.low[axis], config.high[axis], count, config.anchors_at)
            for axis, count in ((0, width), (1, height)))
    of_cell = torch.tensor([[a.z, *a.size, yaw] for a in config.anchors for yaw in config.yaws])
    anchors = torch.empty(height, width, len(of_cell), 7)
    anchors[..., 0] = x[None, :, None]
    anchors[..., 1] = y[:, None, None]
    anchors[..., 2:] = of_cell
    return anchors.view(-1, 7).to(device)


def anchor_classes(config: NetworkConfig, device: str | torch.device = "cpu") -> Tensor:
    """(A,) int64: which of config.classes each anchor is for."""
    height, width = config.head_grid
    one = torch.arange(len(config.anchors)).repeat_interleave(len(config.yaws))
    return one.repeat(height * width).to(device)


def _centres(low: float, high: float, count: int, at: str) -> Tensor:
    if at == "ends":
        return torch.linspace(low, high, count)
    return low + (torch.arange(count) + 0.5) * ((high - low) / count)
