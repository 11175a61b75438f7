"""Boxes as the numbers that the network gives, and back (paper C, Eq. 18 and 19).

In the frame of clusters.py, straight ahead: the centre of the whole object from the mean of the
points that were seen, metres; log of l w h over the class's mean; yaw as a bin and the rest of it,
in halves of a bin, -1 .. 1.
"""

from __future__ import annotations

from typing import Generic, NamedTuple, TypeVar

import numpy as np

from lidar_perception.detectors.pointnet.clusters import ClusterInput
from lidar_perception.detectors.pointnet.config import PointNetConfig
from lidar_perception.geometry import wrap_angle

Array = TypeVar("Array")  # of NumPy or torch


class Outputs(NamedTuple, Generic[Array]):
    """The output of a network for B clusters: logits (B, K + 1), background last; centres (B, 3),
    sizes (B, 3), yaw_bins (B, Y) and yaw_residuals (B, Y) as above, Y bins."""

    logits: Array
    centres: Array
    sizes: Array
    yaw_bins: Array
    yaw_residuals: Array


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


def decode(outputs: Outputs[np.ndarray], inputs: ClusterInput, config: PointNetConfig,
           labels: np.ndarray) -> np.ndarray:
    """(K, 7) float32 boxes, if cluster i is of class labels[i]: the inverse of encode."""
    centres, logs, residuals = (x.astype(np.float64) for x in
                                (outputs.centres, outputs.sizes, outputs.yaw_residuals))
    bins = outputs.yaw_bins.argmax(axis=1)
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
