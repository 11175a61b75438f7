"""What a detector is: a frame in, a value out, and nothing to be read off it afterwards.

PointPillars, PointNet, fused, exported networks and STM-CPA candidates all fulfil this; nodes,
scores, training and scripts know nothing else of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike

from lidar_perception.intensity import find_scale_problem, guess_scale, to_unit
from lidar_perception.types import (
    Detections,
    PointCloud,
    as_point_cloud,
    check_columns,
    usable_returns,
)

Cloud = PointCloud | ArrayLike  # see PointCloud.of
FUSED = "fused"  # the default where one detector is wanted: all of them together


@dataclass(frozen=True)
class DetectionResult:
    """The result of a detector for one cloud.

    Attributes:
        detections: in the coordinates of the cloud, without the vehicle that carries the sensor.
        timings: milliseconds of each step (on CUDA after synchronisation).
        problem: why nothing, or little, can be detected, with the remedy, or None.
        best: highest score of each class if no score reached its threshold; otherwise empty.
    """

    detections: Detections
    timings: Mapping[str, float] = field(default_factory=dict)
    problem: str | None = None
    best: Mapping[str, float] = field(default_factory=dict)


class Detector(Protocol):
    """detector(cloud) -> DetectionResult. classes: names of types.CLASSES that it can detect."""

    @property
    def classes(self) -> tuple[str, ...]: ...

    @property
    def min_scores(self) -> Mapping[str, float]:
        """By class, the least score of a detection."""

    def with_min_score(self, min_score: float) -> Self:
        """The same detector with this least score for every class; this one stays as it is."""

    def with_sensor_height(self, height: float) -> Self:
        """The same detector for a sensor so many metres above the ground; this one stays as it
        is."""

    def __call__(self, cloud: Cloud, *, ground: np.ndarray | None = None,
                 cluster_ids: np.ndarray | None = None) -> DetectionResult:
        """Return the objects in a cloud of N points, N may be 0.

        Args:
            cloud: a PointCloud, or an array as PointCloud.of takes it: (N, 3) [x y z] or (N, 4)
                [x y z intensity], metres, x forward, y left, z up.
            ground: (N,) bool from a stage before; computed where it is None and needed.
            cluster_ids: (N,) int, 0 and below = none; computed where it is None and needed.

        Raises:
            InputError: columns of another length, and a cloud that cannot be used.
        """


class Accepted(NamedTuple):
    """Checked arguments of a detector: the usable points of the cloud with the intensity in 0..1,
    their columns, and the find_scale_problem() of the intensity."""

    frame: PointCloud
    ground: np.ndarray | None
    cluster_ids: np.ndarray | None
    problem: str | None = None


def accept(cloud: Cloud, ground: np.ndarray | None, cluster_ids: np.ndarray | None,
           intensity_scale: float = 1.0) -> Accepted:
    """Check and convert the arguments of a detector, see Detector.__call__. An intensity that is
    not in 0..1 is divided by the scale that it seems to have, which is a guess from this cloud
    alone, so that problem says it.

    intensity_scale: the factor by which the detector multiplies the intensity; 0: it reads none.
    """
    frame = as_point_cloud(cloud)
    check_columns(len(frame), ground=ground, cluster_ids=cluster_ids)
    ground = None if ground is None else np.asarray(ground, bool)
    cluster_ids = None if cluster_ids is None else np.asarray(cluster_ids)
    if frame is not cloud and not (usable := usable_returns(frame.xyz)).all():
        kept = np.flatnonzero(usable)
        frame = frame.take(kept)
        ground, cluster_ids = (column if column is None else column.take(kept)
                               for column in (ground, cluster_ids))
    problem = find_scale_problem(frame.intensity, intensity_scale)
    if problem and frame.intensity is not None:
        full = guess_scale(frame.intensity, intensity_scale)
        if full != 1.0:
            frame = replace(frame, intensity=to_unit(frame.intensity, full))
    return Accepted(frame, ground, cluster_ids, problem)


def joined(*problems: str | None) -> str | None:
    """Return the problems as one, in this order, without those that a later one repeats; None
    without any."""
    said = [problem for problem in problems if problem]
    return "; ".join(problem for i, problem in enumerate(said)
                     if not any(problem in later for later in said[i + 1:])) or None
