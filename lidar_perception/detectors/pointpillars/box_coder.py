"""Boxes to what the network predicts relative to an anchor, and back (SECOND, Yan et al. 2018).

The angle is coded without its direction, which half of the circle it lies in: that is a bin of its
own.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def encode(boxes: Tensor, anchors: Tensor, offset: float) -> tuple[Tensor, Tensor]:
    """codes (N, 7) float32 and bins (N,) int64, 0 or 1, of boxes (N, 7) [x y z l w h yaw] relative
    to anchors (N, 7). l w h must be above 0."""
    diagonal = torch.hypot(anchors[:, 3], anchors[:, 4])
    codes = torch.stack([
        (boxes[:, 0] - anchors[:, 0]) / diagonal,
        (boxes[:, 1] - anchors[:, 1]) / diagonal,
        (boxes[:, 2] - anchors[:, 2]) / anchors[:, 5],
        *torch.log(boxes[:, 3:6] / anchors[:, 3:6]).unbind(1),
        boxes[:, 6] - anchors[:, 6]], dim=1)
    return codes, direction(boxes[:, 6], offset)


def decode(codes: Tensor, bins: Tensor, anchors: Tensor, offset: float) -> Tensor:
    """(N, 7) boxes, yaw in [-pi, pi): the inverse of encode; of the angle in codes only the line
    counts, bins say its direction. Sizes are at most e^4 times the anchor's."""
    diagonal = torch.hypot(anchors[:, 3], anchors[:, 4])
    line = codes[:, 6] + anchors[:, 6] - offset
    yaw = line - torch.floor(line / math.pi) * math.pi + offset + math.pi * bins.to(line.dtype)
    return torch.stack([
        codes[:, 0] * diagonal + anchors[:, 0],
        codes[:, 1] * diagonal + anchors[:, 1],
        codes[:, 2] * anchors[:, 5] + anchors[:, 2],
        *(torch.exp(codes[:, 3:6].clamp(max=4.0)) * anchors[:, 3:6]).unbind(1),
        torch.remainder(yaw + math.pi, 2 * math.pi) - math.pi], dim=1)


def direction(yaw: Tensor, offset: float) -> Tensor:
    """0 for yaw in [offset, offset + pi), 1 for the other half of the circle; int64."""
    turned = torch.remainder(yaw - offset, 2 * math.pi)
    return (turned >= math.pi).long()
