"""The output of a PointPillars network, and what an engine that computes it looks like."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from lidar_perception.detectors.pointpillars.pillars import Pillars


class Prediction(NamedTuple):
    """The output of a network for one cloud.

    logits: (M, K) float32 of the anchors that were evaluated.
    boxes_at: Returns codes (N, 7) and directions (N, 2), float32, at rows (N,) of logits.
    anchors: (M,) int64, the anchors of these rows; None where they are all anchors in order.
    """

    logits: np.ndarray
    boxes_at: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    anchors: np.ndarray | None = None


class Network(Protocol):
    """A network that a PointPillarsProposer can run."""

    has_fixed_range: bool  # it sees only the range that it was made for

    def to(self, device: str) -> None:
        """Move to another device if the network can."""

    def __call__(self, pillars: Pillars[np.ndarray], maps: np.ndarray | None) -> Prediction:
        """Return the outputs for one cloud.

        Args:
            maps: (1, 3, H, W) uint8, the map of the clusters; None if the network reads none.
        """
