"""Training loss of PointNet (paper C, Eq. 18)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from lidar_perception.detectors.pointnet.box_head import BoxTargets, Outputs

BOX_WEIGHT, YAW_BIN_WEIGHT = 1.0, 0.3  # weights (lambda of Eq. 18) of the box loss and the yaw bin loss
SMOOTH = 0.2  # the box loss is linear above this error


class Losses(NamedTuple):
    """Loss terms as scalars; total is the weighted sum of the others."""

    total: Tensor
    classes: Tensor
    boxes: Tensor
    yaw_bins: Tensor


def cluster_loss(
    outputs: Outputs[Tensor],
    labels: Tensor,
    targets: BoxTargets[Tensor],
    has_box: Tensor,
    weights: Tensor | None = None,
) -> Losses:
    """Compute the training loss of B clusters.

    It is the sum of the cross entropy of the labels, the smooth L1 loss of boxes, and the cross
    entropy of yaw bins.

    Args:
        labels: (B,) class, K for background, -1 for unknown (ignored).
        targets: B encoded boxes.
        has_box: (B,) bool, clusters included in the box loss.
        weights: (K + 1,) weight of each class; None: 1.
    """
    classes = functional.cross_entropy(outputs.logits.float(), labels, weight=weights, ignore_index=-1)
    if not has_box.any():
        zero = sum((x.sum() for x in outputs), classes.new_zeros(())) * 0.0
        return Losses(classes + zero, classes, zero, zero)
    bins = targets.yaw_bins[has_box]
    residuals = outputs.yaw_residuals[has_box].gather(1, bins[:, None])[:, 0]
    predicted = torch.cat([outputs.centres[has_box], outputs.sizes[has_box], residuals[:, None]], 1)
    expected = torch.cat([targets.centres[has_box], targets.sizes[has_box], targets.yaw_residuals[has_box][:, None]], 1)
    boxes = functional.smooth_l1_loss(predicted.float(), expected, beta=SMOOTH, reduction="none").sum(dim=1).mean()
    yaw_bins = functional.cross_entropy(outputs.yaw_bins[has_box].float(), bins)
    total = classes + BOX_WEIGHT * boxes + YAW_BIN_WEIGHT * yaw_bins
    return Losses(total, classes, boxes, yaw_bins)
