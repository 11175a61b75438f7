"""What a network is trained to lower (Lang et al., Section 3.2; focal loss: Lin et al. 2017)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from lidar_perception.detection.pointpillars import Outputs
from lidar_perception.detection.targets import IGNORED, Targets

CLASS_WEIGHT, BOX_WEIGHT, DIRECTION_WEIGHT = 1.0, 2.0, 0.2
ALPHA, GAMMA = 0.25, 2.0
SMOOTH = 1 / 9  # from here on the box loss is linear


class Losses(NamedTuple):
    """Scalars; total is the weighted sum of the others."""

    total: Tensor
    classes: Tensor
    boxes: Tensor
    directions: Tensor


def detection_loss(outputs: Outputs, targets: Targets) -> Losses:
    """Each cloud's losses divided by the number of its anchors that have an object (at least 1),
    averaged over the clouds."""
    positive = targets.labels >= 0                                       # (B, A)
    share = positive.sum(dim=1).clamp(min=1).reciprocal() / len(positive)  # (B,)
    logits = outputs.logits.float()
    wanted = functional.one_hot(targets.labels.clamp(min=0), logits.shape[2]).to(logits.dtype)
    focal = focal_loss(logits, wanted * positive[..., None]).sum(dim=2)  # (B, A)
    classes = ((focal * (targets.labels != IGNORED)).sum(dim=1) * share).sum()
    weight = share[:, None].expand_as(positive)[positive]                # (P,)
    codes, bins = targets.codes[positive], targets.bins[positive]
    found = outputs.codes.float()[positive]
    # sin(a - b), so that a box turned by half a circle costs nothing here
    difference = torch.cat([found[:, :6] - codes[:, :6],
                            torch.sin(found[:, 6:] - codes[:, 6:])], dim=1)
    boxes = functional.smooth_l1_loss(difference, torch.zeros_like(difference), beta=SMOOTH,
                                      reduction="none").sum(dim=1)
    headings = functional.cross_entropy(outputs.directions.float()[positive], bins,
                                        reduction="none")
    boxes, headings = (boxes * weight).sum(), (headings * weight).sum()
    total = CLASS_WEIGHT * classes + BOX_WEIGHT * boxes + DIRECTION_WEIGHT * headings
    return Losses(total, classes, boxes, headings)


def focal_loss(logits: Tensor, wanted: Tensor) -> Tensor:
    """Elementwise; wanted is 0 or 1."""
    entropy = functional.binary_cross_entropy_with_logits(logits, wanted, reduction="none")
    score = torch.sigmoid(logits)
    miss = wanted * (1 - score) + (1 - wanted) * score
    weight = wanted * ALPHA + (1 - wanted) * (1 - ALPHA)
    return weight * miss**GAMMA * entropy
