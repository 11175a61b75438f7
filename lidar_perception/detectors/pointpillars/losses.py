"""Training losses of PointPillars (Lang et al., Section 3.2; focal loss: Lin et al. 2017)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from lidar_perception.detectors.pointpillars.network import Outputs
from lidar_perception.detectors.pointpillars.targets import IGNORED, Targets

CLASS_WEIGHT, BOX_WEIGHT, DIRECTION_WEIGHT = 1.0, 2.0, 0.2
ALPHA, GAMMA = 0.25, 2.0
SMOOTH = 1 / 9  # the box loss is linear above this error


class Losses(NamedTuple):
    """Loss terms as scalars; total is the weighted sum of the others."""

    total: Tensor
    classes: Tensor
    boxes: Tensor
    directions: Tensor


def detection_loss(outputs: Outputs, targets: Targets, classes_of: Tensor) -> Losses:
    """Compute the losses of B clouds.

    The focal loss of each class is divided by its number of positive anchors, then averaged over
    the classes. The losses of boxes and directions are means over all positive anchors. At least one
    anchor per cloud is counted.

    All classes therefore have the same weight. Lang et al. divide by the number of positive anchors
    of all classes, but a car has ten times as many as a pedestrian.

    Args:
        classes_of: (A,) class of each anchor, see anchors.anchor_classes.
    """
    positive = targets.labels >= 0  # (B, A)
    logits = outputs.logits.float()
    clouds, _, classes = logits.shape
    count = logits.new_zeros(classes).index_add_(0, classes_of, positive.sum(dim=0).to(logits))
    anchor_weights = (count.clamp(min=clouds) * classes).reciprocal()[classes_of]  # (A,)
    one_hot = functional.one_hot(targets.labels.clamp(min=0), classes).to(logits.dtype)
    focal = focal_loss(logits, one_hot * positive[..., None]).sum(dim=2)  # (B, A)
    scores = ((focal * (targets.labels != IGNORED)).sum(dim=0) * anchor_weights).sum()
    positive_count = count.sum().clamp(min=clouds)
    codes, bins = targets.codes[positive], targets.bins[positive]  # (P, 7), (P,)
    predicted = outputs.codes.float()[positive]
    # sin(a - b) ignores rotations by 180 degrees, which the direction loss handles
    difference = torch.cat([predicted[:, :6] - codes[:, :6], torch.sin(predicted[:, 6:] - codes[:, 6:])], dim=1)
    boxes = (
        functional.smooth_l1_loss(difference, torch.zeros_like(difference), beta=SMOOTH, reduction="sum")
        / positive_count
    )
    headings = functional.cross_entropy(outputs.directions.float()[positive], bins, reduction="sum") / positive_count
    total = CLASS_WEIGHT * scores + BOX_WEIGHT * boxes + DIRECTION_WEIGHT * headings
    return Losses(total, scores, boxes, headings)


def focal_loss(logits: Tensor, targets: Tensor) -> Tensor:
    """Return the elementwise focal loss; `targets` is 0 or 1."""
    entropy = functional.binary_cross_entropy_with_logits(logits, targets, reduction="none")
    score = torch.sigmoid(logits)
    miss = targets * (1 - score) + (1 - targets) * score
    weight = targets * ALPHA + (1 - targets) * (1 - ALPHA)
    return weight * miss**GAMMA * entropy
