"""The output of PointPillars networks, and their common interface."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from lidar_perception.detectors.pointpillars.pillars import Pillars


class Prediction(NamedTuple):
    """The output of a network for one cloud.

    Attributes:
        logits: (M, K) float32 logits of the evaluated anchors.
        compute_boxes: function of row indices (N,) into `logits` that returns codes (N, 7) and
            directions (N, 2), both float32.
        anchors: (M,) int64 anchor of each row; None: all anchors in order.
    """

    logits: np.ndarray
    compute_boxes: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    anchors: np.ndarray | None = None


class Network(Protocol):
    """A network that a PointPillarsProposer can run."""

    has_fixed_range: bool  # True if the network cannot be used for another range

    def to(self, device: str) -> None:
        """Move the network to another device if it supports this."""

    def __call__(self, pillars: Pillars[np.ndarray], maps: np.ndarray | None) -> Prediction:
        """Return the outputs for one cloud.

        Args:
            maps: (1, 3, H, W) uint8 cluster map; None if the network has no branch for it.
        """
