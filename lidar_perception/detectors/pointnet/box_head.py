"""Encoding of boxes as network outputs, and decoding (paper C, Eq. 19).

A box is encoded in the normalized frame of clusters.py as

- the centre of the box relative to the mean of the points, in metres;
- the logarithm of length, width and height relative to the reference size of the class;
- a yaw bin, and the residual -1..1 in units of half a bin.
"""

from __future__ import annotations

from typing import Generic, NamedTuple, TypeVar

import numpy as np

from lidar_perception.detectors.pointnet.clusters import ClusterInput
from lidar_perception.detectors.pointnet.config import PointNetConfig
from lidar_perception.geometry import wrap_angle

Array = TypeVar("Array")  # NumPy array or torch tensor


class Outputs(NamedTuple, Generic[Array]):
    """Outputs of a network for B clusters.

    Attributes:
        logits: (B, K + 1), with the background last.
        centres, sizes: (B, 3).
        yaw_bins, yaw_residuals: (B, Y) with Y bins.
    """

    logits: Array
    centres: Array
    sizes: Array
    yaw_bins: Array
    yaw_residuals: Array


class BoxTargets(NamedTuple, Generic[Array]):
    """Encoded boxes of K objects.

    Attributes:
        centres, sizes: (K, 3) float32.
        yaw_bins: (K,) int64.
        yaw_residuals: (K,) float32.
    """

    centres: Array
    sizes: Array
    yaw_bins: Array
    yaw_residuals: Array


def encode(
    boxes: np.ndarray, labels: np.ndarray, centres: np.ndarray, azimuths: np.ndarray, config: PointNetConfig
) -> BoxTargets[np.ndarray]:
    """Encode boxes (K, 7) relative to their clusters.

    Args:
        labels: (K,) indices into config.classes.
        centres: (K, 3) means of the clusters, see ClusterInput.
        azimuths: (K,) azimuths of the clusters, see ClusterInput.
    """
    offsets = boxes[:, :3] - centres
    cos, sin = np.cos(azimuths), np.sin(azimuths)
    normalized_offsets = np.column_stack(
        [cos * offsets[:, 0] + sin * offsets[:, 1], cos * offsets[:, 1] - sin * offsets[:, 0], offsets[:, 2]]
    )
    log_sizes = np.log(np.maximum(boxes[:, 3:6], 0.05) / np.array(config.sizes)[labels])
    bin_width = 2 * np.pi / config.yaw_bins
    yaw = np.mod(boxes[:, 6] - azimuths, 2 * np.pi)
    bins = np.mod(np.round(yaw / bin_width).astype(np.int64), config.yaw_bins)
    residuals = wrap_angle(yaw - bins * bin_width) / (bin_width / 2)
    return BoxTargets(
        normalized_offsets.astype(np.float32), log_sizes.astype(np.float32), bins, residuals.astype(np.float32)
    )


def decode(
    outputs: Outputs[np.ndarray], inputs: ClusterInput, config: PointNetConfig, labels: np.ndarray
) -> np.ndarray:
    """Decode boxes (K, 7) float32, the inverse of encode.

    Args:
        labels: (K,) class of each box, indices into config.classes.
    """
    centres, log_sizes, residuals = (
        x.astype(np.float64) for x in (outputs.centres, outputs.sizes, outputs.yaw_residuals)
    )
    bins = outputs.yaw_bins.argmax(axis=1)
    cos, sin = np.cos(inputs.azimuths), np.sin(inputs.azimuths)
    boxes = np.empty((len(bins), 7))
    boxes[:, 0] = inputs.centres[:, 0] + cos * centres[:, 0] - sin * centres[:, 1]
    boxes[:, 1] = inputs.centres[:, 1] + sin * centres[:, 0] + cos * centres[:, 1]
    boxes[:, 2] = inputs.centres[:, 2] + centres[:, 2]
    boxes[:, 3:6] = np.array(config.sizes)[labels] * np.exp(np.clip(log_sizes, -2, 2))
    bin_width = 2 * np.pi / config.yaw_bins
    bin_residuals = np.clip(residuals[np.arange(len(bins)), bins], -1, 1)
    boxes[:, 6] = wrap_angle(inputs.azimuths + (bins + bin_residuals / 2) * bin_width)
    return boxes.astype(np.float32)
