"""Output of a PointPillars network, and the interface of networks."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from lidar_perception.detectors.pointpillars.pillars import Pillars


class Prediction(NamedTuple):
    """The output of a network for one cloud.

    Attributes:
        logits: (M, K) float32 of the evaluated anchors.
        boxes_at: boxes_at(rows (N,)) returns codes (N, 7) and directions (N, 2), float32, for rows
            of logits.
        anchors: (M,) int64, the anchor of each row; None: all anchors in order.
    """

    logits: np.ndarray
    boxes_at: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    anchors: np.ndarray | None = None


class Network(Protocol):
    """A network that a PointPillarsProposer can run."""

    has_fixed_range: bool  # True if the network cannot be used for another range

    def to(self, device: str) -> None:
        """Move to another device if the network can."""

    def __call__(self, pillars: Pillars[np.ndarray], maps: np.ndarray | None) -> Prediction:
        """Return the outputs for one cloud.

        Args:
            maps: (1, 3, H, W) uint8 cluster map; None if the network has no branch for it.
        """
