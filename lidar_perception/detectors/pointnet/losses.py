"""Training loss of PointNet (paper C, Eq. 18)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from lidar_perception.detectors.pointnet.box_head import BoxTargets, Outputs

BOX_WEIGHT, YAW_BIN_WEIGHT = 1.0, 0.3  # weights lambda in Eq. 18
SMOOTH_L1_BETA = 0.2  # error above which the box loss is linear


class Losses(NamedTuple):
    """Loss terms as scalars; total is the weighted sum of the others."""

    total: Tensor
    classes: Tensor
    boxes: Tensor
    yaw_bins: Tensor


def compute_cluster_loss(
    outputs: Outputs[Tensor],
    labels: Tensor,
    targets: BoxTargets[Tensor],
    has_box: Tensor,
    weights: Tensor | None = None,
) -> Losses:
    """Compute the training loss of B clusters.

    It is the weighted sum of the cross entropy of classes, the smooth L1 loss of boxes, and the
    cross entropy of yaw bins.

    Args:
        labels: (B,) class, K for background, -1 for unknown (ignored).
        targets: B encoded boxes.
        has_box: (B,) bool mask of the clusters that contribute to the box loss.
        weights: (K + 1,) weight of each class; None: 1.
    """
    class_loss = functional.cross_entropy(outputs.logits.float(), labels, weight=weights, ignore_index=-1)
    if not has_box.any():
        zero = sum((x.sum() for x in outputs), class_loss.new_zeros(())) * 0.0  # keeps all outputs in the graph
        return Losses(class_loss + zero, class_loss, zero, zero)
    target_bins = targets.yaw_bins[has_box]
    residuals = outputs.yaw_residuals[has_box].gather(1, target_bins[:, None])[:, 0]
    codes = torch.cat([outputs.centres[has_box], outputs.sizes[has_box], residuals[:, None]], 1).float()
    target_codes = torch.cat(
        [targets.centres[has_box], targets.sizes[has_box], targets.yaw_residuals[has_box][:, None]], 1
    )
    box_loss = functional.smooth_l1_loss(codes, target_codes, beta=SMOOTH_L1_BETA, reduction="none").sum(dim=1).mean()
    yaw_bin_loss = functional.cross_entropy(outputs.yaw_bins[has_box].float(), target_bins)
    total = class_loss + BOX_WEIGHT * box_loss + YAW_BIN_WEIGHT * yaw_bin_loss
    return Losses(total, class_loss, box_loss, yaw_bin_loss)
