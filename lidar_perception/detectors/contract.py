"""What a detector is: a frame in, a value out, and nothing to be read off it afterwards.

PointPillars, PointNet, exported networks, STM-CPA candidates and the hybrids all fulfil this;
nodes, scores, training and scripts know nothing else of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol, Self

import numpy as np

from lidar_perception.types import Detections, InputError, LidarFrame

FUSED = "fused"  # the default where one detector is wanted: all of them together


@dataclass(frozen=True)
class Found:
    """What a detector says of one frame.

    detections in the frame's own coordinates, without what carries the sensor; ms: time of each
    step (on CUDA after synchronisation); problem: why nothing, or little, can be detected, with the
    remedy, or None; best: where no score reached its threshold, the highest score of each class.
    """

    detections: Detections
    ms: Mapping[str, float] = field(default_factory=dict)
    problem: str | None = None
    best: Mapping[str, float] = field(default_factory=dict)


class Detector(Protocol):
    """detector(frame) -> Found. classes: names of types.CLASSES that it can detect."""

    @property
    def classes(self) -> tuple[str, ...]: ...

    @property
    def min_scores(self) -> Mapping[str, float]:
        """By class, the least score of a detection."""

    def with_min_score(self, min_score: float) -> Self:
        """The same detector with this least score for every class; this one stays as it is."""

    def mounted_at(self, height: float) -> Self:
        """The same detector for a sensor so many metres above the ground; this one stays as it
        is."""

    def __call__(self, frame: LidarFrame, *, ground: np.ndarray | None = None,
                 cluster_ids: np.ndarray | None = None) -> Found:
        """The objects in a frame of N points, N may be 0. ground (N,) bool and cluster_ids (N,)
        int, 0 and below = none, come from nodes before it; they are computed where they are None
        and the detector needs them. InputError for columns of another length, and where the frame
        cannot be used."""


def require_columns(frame: LidarFrame, **columns: np.ndarray | None) -> None:
    """InputError naming a column, if there is one, that has not a value for each point."""
    for name, column in columns.items():
        if column is not None and len(column) != len(frame):
            raise InputError(f"{name} has {len(column)} values for {len(frame)} points")
