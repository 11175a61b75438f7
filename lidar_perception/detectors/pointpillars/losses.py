"""Training losses of PointPillars (Lang et al., Section 3.2; focal loss: Lin et al. 2017)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from lidar_perception.detectors.pointpillars.network import Outputs
from lidar_perception.detectors.pointpillars.targets import IGNORED, Targets

CLASS_WEIGHT, BOX_WEIGHT, DIRECTION_WEIGHT = 1.0, 2.0, 0.2
ALPHA, GAMMA = 0.25, 2.0  # parameters of the focal loss
SMOOTH_L1_BETA = 1 / 9  # error above which the box loss is linear


class Losses(NamedTuple):
    """Loss terms as scalars; total is the weighted sum of the others."""

    total: Tensor
    classes: Tensor
    boxes: Tensor
    directions: Tensor


def compute_detection_loss(outputs: Outputs, targets: Targets, anchor_classes: Tensor) -> Losses:
    """Compute the losses of B clouds.

    The focal loss of each class is divided by its number of positive anchors, then averaged over
    the classes. The losses of boxes and directions are divided by the number of all positive
    anchors. These numbers are at least B.

    All classes therefore have the same weight. Lang et al. divide by the number of positive anchors
    of all classes, but a car has ten times as many of them as a pedestrian.

    Args:
        anchor_classes: (A,) class of each anchor, see anchors.get_anchor_classes.
    """
    is_positive = targets.labels >= 0  # (B, A)
    logits = outputs.logits.float()
    cloud_count, _, class_count = logits.shape
    counts = logits.new_zeros(class_count).index_add_(0, anchor_classes, is_positive.sum(dim=0).to(logits))
    anchor_weights = (counts.clamp(min=cloud_count) * class_count).reciprocal()[anchor_classes]  # (A,)
    one_hot = functional.one_hot(targets.labels.clamp(min=0), class_count).to(logits.dtype)
    focal_loss = compute_focal_loss(logits, one_hot * is_positive[..., None]).sum(dim=2)  # (B, A)
    class_loss = ((focal_loss * (targets.labels != IGNORED)).sum(dim=0) * anchor_weights).sum()
    positive_count = counts.sum().clamp(min=cloud_count)
    target_codes, target_bins = targets.codes[is_positive], targets.bins[is_positive]  # (P, 7), (P,)
    codes, directions = outputs.codes.float()[is_positive], outputs.directions.float()[is_positive]
    # sin(a - b) ignores rotations by 180 degrees, which the direction loss covers.
    error = torch.cat([codes[:, :6] - target_codes[:, :6], torch.sin(codes[:, 6:] - target_codes[:, 6:])], dim=1)
    box_loss = (
        functional.smooth_l1_loss(error, torch.zeros_like(error), beta=SMOOTH_L1_BETA, reduction="sum") / positive_count
    )
    direction_loss = functional.cross_entropy(directions, target_bins, reduction="sum") / positive_count
    total = CLASS_WEIGHT * class_loss + BOX_WEIGHT * box_loss + DIRECTION_WEIGHT * direction_loss
    return Losses(total, class_loss, box_loss, direction_loss)


def compute_focal_loss(logits: Tensor, targets: Tensor) -> Tensor:
    """Compute the elementwise focal loss for targets that are 0 or 1."""
    entropy = functional.binary_cross_entropy_with_logits(logits, targets, reduction="none")
    scores = torch.sigmoid(logits)
    errors = targets * (1 - scores) + (1 - targets) * scores
    weights = targets * ALPHA + (1 - targets) * (1 - ALPHA)
    return weights * errors**GAMMA * entropy
