"""Boxes as the numbers that the network gives, and back (paper C, Eq. 18 and 19).

In the frame of clusters.py, straight ahead: the centre of the whole object from the mean of the
points that were seen, metres; log of l w h over the class's mean; yaw as a bin and the rest of it,
in halves of a bin, -1 .. 1.
"""

from __future__ import annotations

from typing import Generic, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from lidar_perception.detectors.pointnet.clusters import ClusterInput
from lidar_perception.detectors.pointnet.config import PointNetConfig
from lidar_perception.detectors.pointnet.network import Outputs
from lidar_perception.geometry import wrap_angle

BOX_WEIGHT, YAW_BIN_WEIGHT = 1.0, 0.3  # lambda of Eq. 18, of boxes and of yaw bins
SMOOTH = 0.2       # m, and like numbers: from here on the box loss is linear


Array = TypeVar("Array", np.ndarray, Tensor)


class BoxTargets(NamedTuple, Generic[Array]):
    """centres (K, 3), sizes (K, 3), yaw_residuals (K,) float32, yaw_bins (K,) int64."""

    centres: Array
    sizes: Array
    yaw_bins: Array
    yaw_residuals: Array


def encode(boxes: np.ndarray, labels: np.ndarray, centres: np.ndarray, azimuths: np.ndarray,
           config: PointNetConfig) -> BoxTargets[np.ndarray]:
    """Targets of boxes (K, 7) of classes labels (K,) into config.classes, for clusters with these
    centres (K, 3) and azimuths (K,)."""
    offset = boxes[:, :3] - centres
    cos, sin = np.cos(azimuths), np.sin(azimuths)
    turned = np.column_stack([cos * offset[:, 0] + sin * offset[:, 1],
                              cos * offset[:, 1] - sin * offset[:, 0], offset[:, 2]])
    sizes = np.log(np.maximum(boxes[:, 3:6], 0.05) / np.array(config.sizes)[labels])
    width = 2 * np.pi / config.yaw_bins
    yaw = np.mod(boxes[:, 6] - azimuths, 2 * np.pi)
    bins = np.mod(np.round(yaw / width).astype(np.int64), config.yaw_bins)
    rest = wrap_angle(yaw - bins * width) / (width / 2)
    return BoxTargets(turned.astype(np.float32), sizes.astype(np.float32), bins,
                      rest.astype(np.float32))


def decode(outputs: Outputs, inputs: ClusterInput, config: PointNetConfig,
           labels: np.ndarray) -> np.ndarray:
    """(K, 7) float32 boxes, if cluster i is of class labels[i]: the inverse of encode."""
    centres, logs, residuals = (x.float().cpu().numpy().astype(np.float64) for x in
                                (outputs.centres, outputs.sizes, outputs.yaw_residuals))
    bins = outputs.yaw_bins.argmax(dim=1).cpu().numpy()
    cos, sin = np.cos(inputs.azimuths), np.sin(inputs.azimuths)
    boxes = np.empty((len(bins), 7))
    boxes[:, 0] = inputs.centres[:, 0] + cos * centres[:, 0] - sin * centres[:, 1]
    boxes[:, 1] = inputs.centres[:, 1] + sin * centres[:, 0] + cos * centres[:, 1]
    boxes[:, 2] = inputs.centres[:, 2] + centres[:, 2]
    boxes[:, 3:6] = np.array(config.sizes)[labels] * np.exp(np.clip(logs, -2, 2))
    width = 2 * np.pi / config.yaw_bins
    rest = np.clip(residuals[np.arange(len(bins)), bins], -1, 1)
    boxes[:, 6] = wrap_angle(inputs.azimuths + (bins + rest / 2) * width)
    return boxes.astype(np.float32)


class Losses(NamedTuple):
    """Scalars; total is the weighted sum of the others."""

    total: Tensor
    classes: Tensor
    boxes: Tensor
    yaw_bins: Tensor


def cluster_loss(outputs: Outputs, labels: Tensor, targets: BoxTargets[Tensor], has_box: Tensor,
                 weights: Tensor | None = None) -> Losses:
    """Cross entropy of labels (B,), K for background and -1 for those of which nothing is said,
    with a weight (K + 1,) for each class; smooth L1 of the boxes of those that have one (B,) bool,
    and cross entropy of their yaw bins. targets: of B rows."""
    classes = functional.cross_entropy(outputs.logits.float(), labels, weight=weights,
                                       ignore_index=-1)
    if not has_box.any():
        zero = sum((x.sum() for x in outputs), classes.new_zeros(())) * 0.0
        return Losses(classes + zero, classes, zero, zero)
    bins = targets.yaw_bins[has_box]
    residuals = outputs.yaw_residuals[has_box].gather(1, bins[:, None])[:, 0]
    found = torch.cat([outputs.centres[has_box], outputs.sizes[has_box], residuals[:, None]], 1)
    wanted = torch.cat([targets.centres[has_box], targets.sizes[has_box],
                        targets.yaw_residuals[has_box][:, None]], 1)
    boxes = functional.smooth_l1_loss(found.float(), wanted, beta=SMOOTH,
                                      reduction="none").sum(dim=1).mean()
    yaw_bins = functional.cross_entropy(outputs.yaw_bins[has_box].float(), bins)
    total = classes + BOX_WEIGHT * boxes + YAW_BIN_WEIGHT * yaw_bins
    return Losses(total, classes, boxes, yaw_bins)
