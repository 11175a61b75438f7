"""Assignment of training targets to anchors (Lang et al., Section 4.1; matching as in SECOND)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidar_perception.detectors.pointpillars.config import NetworkConfig

BACKGROUND, IGNORED = -1, -2


class Targets(NamedTuple):
    """Training targets of the network for B clouds.

    Attributes:
        labels: (B, A) int64, index into config.classes, BACKGROUND or IGNORED.
        codes: (B, A, 7), see encode; 0 if the label is not a class.
        bins: (B, A) int64, see encode; 0 if the label is not a class.
    """

    labels: Tensor
    codes: Tensor
    bins: Tensor


class SparseTargets(NamedTuple):
    """Targets of one cloud at the few anchors that are not background.

    Attributes:
        anchors: (K,) int64 indices.
        labels, codes, bins: (K,), (K, 7) and (K,), see Targets.
    """

    anchors: np.ndarray
    labels: np.ndarray
    codes: np.ndarray
    bins: np.ndarray


def encode(boxes: Tensor, anchors: Tensor, offset: float) -> tuple[Tensor, Tensor]:
    """Encode boxes relative to anchors, the inverse of anchors.decode.

    Args:
        boxes: (N, 7) [x y z l w h yaw]; l w h must be above 0.
        anchors: (N, 7).
        offset: start of the bins, radians.

    Returns:
        Codes (N, 7) float32 and bins (N,) int64, 0 or 1.
    """
    diagonal = torch.hypot(anchors[:, 3], anchors[:, 4])
    codes = torch.stack(
        [
            (boxes[:, 0] - anchors[:, 0]) / diagonal,
            (boxes[:, 1] - anchors[:, 1]) / diagonal,
            (boxes[:, 2] - anchors[:, 2]) / anchors[:, 5],
            *torch.log(boxes[:, 3:6] / anchors[:, 3:6]).unbind(1),
            boxes[:, 6] - anchors[:, 6],
        ],
        dim=1,
    )
    return codes, find_heading_bin(boxes[:, 6], offset)


def find_heading_bin(yaw: Tensor, offset: float) -> Tensor:
    """Return bins (N,) int64: 0 for yaw in [offset, offset + pi), otherwise 1."""
    relative_yaw = torch.remainder(yaw - offset, 2 * math.pi)
    return (relative_yaw >= math.pi).long()


def assign_targets(anchors: Tensor, config: NetworkConfig, boxes: Tensor, labels: Tensor) -> Targets:
    """Assign the objects of one cloud to anchors and return the targets (B = 1).

    Each class is matched separately. An anchor is positive if its best IoU is at least `matched`,
    background if it is below `unmatched`, and ignored otherwise. The anchors with the highest IoU
    with an object are always positive. IoU is computed in the bird's-eye view with boxes rotated to
    the nearest axis. Objects with a size of 0 or with values that are not finite are skipped.

    Args:
        anchors: (A, 7) from make_anchors.
        boxes: (M, 7) labelled objects.
        labels: (M,) int64, indices into config.classes.
    """
    out_labels = labels.new_full((len(anchors),), BACKGROUND)
    codes = anchors.new_zeros(len(anchors), 7)
    bins = labels.new_zeros(len(anchors))
    is_usable = (boxes[:, 3:6] > 0).all(dim=1) & torch.isfinite(boxes).all(dim=1)
    for index, spec in enumerate(config.anchors):
        objects = boxes[is_usable & (labels == index)].to(anchors.dtype)
        candidates = find_near_anchors(anchors, config, objects, index)
        if len(candidates) == 0:
            continue
        iou = nearest_axis_iou(anchors[candidates], objects)  # (A', M')
        anchor_iou, object_indices = iou.max(dim=1)
        object_iou = iou.max(dim=0).values
        is_best = (iou == object_iou) & (object_iou > 0)
        object_indices = torch.where(is_best.any(dim=1), is_best.int().argmax(dim=1), object_indices)
        is_positive = is_best.any(dim=1) | (anchor_iou >= spec.matched)
        out_labels[candidates[(anchor_iou >= spec.unmatched) & ~is_positive]] = IGNORED
        positive_anchors, matched_objects = candidates[is_positive], objects[object_indices[is_positive]]
        out_labels[positive_anchors] = index
        codes[positive_anchors], bins[positive_anchors] = encode(
            matched_objects, anchors[positive_anchors], config.direction_offset
        )
    return Targets(out_labels[None], codes[None], bins[None])


def find_near_anchors(anchors: Tensor, config: NetworkConfig, boxes: Tensor, index: int) -> Tensor:
    """Return the indices (A',) int64, ascending, of anchors that may overlap one of the boxes (M, 7).

    Most anchors are far from all objects, so this saves most of the work.

    Args:
        index: class of the anchors, index into config.anchors.
    """
    per_cell = len(config.anchors) * len(config.yaws)
    cells = anchors.view(*config.head_grid, per_cell, 7)
    max_distance = (boxes[:, 3:5].amax(dim=1) + max(config.anchors[index].size[:2])) / 2
    column = (cells[0, :, 0, 0, None] - boxes[:, 0]).abs() <= max_distance  # (W, M)
    row = (cells[:, 0, 0, 1, None] - boxes[:, 1]).abs() <= max_distance  # (H, M)
    is_near = (row[:, None] & column).any(dim=2).flatten()  # (H * W,)
    first_anchors = torch.nonzero(is_near) * per_cell + index * len(config.yaws)  # (cells, 1)
    return (first_anchors + torch.arange(len(config.yaws), device=anchors.device)).reshape(-1)


def to_sparse(targets: Targets) -> SparseTargets:
    """Convert the targets of one cloud (B = 1), on the CPU, to SparseTargets."""
    labels = targets.labels[0]
    anchors = torch.nonzero(labels != BACKGROUND)[:, 0]
    return SparseTargets(anchors.numpy(), *(part[0][anchors].numpy() for part in targets))


def to_dense(clouds: Sequence[SparseTargets], anchor_count: int, device: torch.device) -> Targets:
    """Convert the SparseTargets of B clouds to Targets on a device."""
    indices = torch.from_numpy(np.concatenate([cloud.anchors + i * anchor_count for i, cloud in enumerate(clouds)])).to(
        device
    )

    def scatter(parts: Sequence[np.ndarray], default: int) -> Tensor:
        values = torch.from_numpy(np.concatenate(parts)).to(device)
        shape = (len(clouds) * anchor_count, *values.shape[1:])
        out = torch.full(shape, default, dtype=values.dtype, device=device)
        return out.index_copy_(0, indices, values).view(len(clouds), anchor_count, *values.shape[1:])

    return Targets(
        scatter([c.labels for c in clouds], BACKGROUND),
        scatter([c.codes for c in clouds], 0),
        scatter([c.bins for c in clouds], 0),
    )


def nearest_axis_iou(boxes: Tensor, others: Tensor) -> Tensor:
    """Return the bird's-eye-view IoU (N, M) of boxes (N, 7) and others (M, 7) rotated to the nearest axis."""
    (low, high), (other_low, other_high) = _align_boxes(boxes), _align_boxes(others)
    intersection = torch.minimum(high[:, None], other_high) - torch.maximum(low[:, None], other_low)
    intersection = intersection.clamp_(min=0).prod(dim=2)
    area, other_area = (high - low).prod(dim=1), (other_high - other_low).prod(dim=1)
    return intersection / (area[:, None] + other_area - intersection)


def _align_boxes(boxes: Tensor) -> tuple[Tensor, Tensor]:
    """Rotate boxes (N, 7) to the nearest axis; return their corners low (N, 2) and high (N, 2)."""
    line_angle = torch.remainder(boxes[:, 6] + math.pi / 2, math.pi) - math.pi / 2
    is_sideways = (line_angle.abs() > math.pi / 4)[:, None]
    half_sizes = torch.where(is_sideways, boxes[:, [4, 3]], boxes[:, [3, 4]]) / 2
    return boxes[:, :2] - half_sizes, boxes[:, :2] + half_sizes
