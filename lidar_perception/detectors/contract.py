"""The interface of all detectors: a function from a point cloud to a DetectionResult."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike

from lidar_perception.intensity import find_scale_problem, guess_scale, to_unit
from lidar_perception.types import Detections, PointCloud, are_usable_returns, as_point_cloud, check_columns

Cloud = PointCloud | ArrayLike  # see PointCloud.of()
FUSED = "fused"  # name of the default detector


@dataclass(frozen=True)
class DetectionResult:
    """The result of a detector for one cloud.

    Attributes:
        detections: detections in the coordinates of the cloud, without the ego vehicle.
        timings: duration of each step in milliseconds (on CUDA after synchronization).
        problem: reason why few or no objects can be detected, with a remedy, or None.
        best: highest score of each class if no score reached its threshold, otherwise empty.
    """

    detections: Detections
    timings: Mapping[str, float] = field(default_factory=dict)
    problem: str | None = None
    best: Mapping[str, float] = field(default_factory=dict)


class Detector(Protocol):
    """An object detector: detector(cloud) returns a DetectionResult."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the detectable classes, a subset of types.CLASSES."""

    @property
    def min_scores(self) -> Mapping[str, float]:
        """Minimum score of a detection, by class."""

    def with_min_score(self, min_score: float) -> Self:
        """Return a copy of this detector with one threshold for all classes."""

    def with_sensor_height(self, height: float) -> Self:
        """Return a copy of this detector for a sensor `height` metres above the ground."""

    def __call__(
        self, cloud: Cloud, *, ground: np.ndarray | None = None, cluster_ids: np.ndarray | None = None
    ) -> DetectionResult:
        """Detect the objects in a cloud of N points; N may be 0.

        Args:
            cloud: a PointCloud, or an array that PointCloud.of accepts: (N, 3) [x y z] or (N, 4)
                [x y z intensity], metres, x forward, y left, z up.
            ground: (N,) bool from an earlier stage; None: computed if the detector needs it.
            cluster_ids: (N,) int, 0 and below for no cluster; None: computed if needed.

        Raises:
            InputError: a column has the wrong length, or the cloud cannot be used.
        """


class CheckedInput(NamedTuple):
    """Checked and converted arguments of a detector.

    Attributes:
        frame: the usable points of the cloud, with intensity in 0..1.
        ground, cluster_ids: values for these points, or None.
        problem: problem with the intensity scale, see find_scale_problem, or None.
    """

    frame: PointCloud
    ground: np.ndarray | None
    cluster_ids: np.ndarray | None
    problem: str | None = None


def check_input(
    cloud: Cloud, ground: np.ndarray | None, cluster_ids: np.ndarray | None, use_intensity: bool = True
) -> CheckedInput:
    """Check and convert the arguments of Detector.__call__.

    Intensities outside 0..1 are divided by a scale that is guessed from this cloud alone, so the
    scale is also reported as a problem.

    Args:
        use_intensity: False if the detector ignores the intensity.
    """
    frame = as_point_cloud(cloud)
    check_columns(len(frame), ground=ground, cluster_ids=cluster_ids)
    ground = None if ground is None else np.asarray(ground, bool)
    cluster_ids = None if cluster_ids is None else np.asarray(cluster_ids)
    if frame is not cloud and not (is_usable := are_usable_returns(frame.xyz)).all():
        indices = np.flatnonzero(is_usable)
        frame = frame.take(indices)
        ground, cluster_ids = (column if column is None else column.take(indices) for column in (ground, cluster_ids))
    problem = find_scale_problem(frame.intensity) if use_intensity else None
    if problem and frame.intensity is not None:
        scale = guess_scale(frame.intensity)
        if scale != 1.0:
            frame = replace(frame, intensity=to_unit(frame.intensity, scale))
    return CheckedInput(frame, ground, cluster_ids, problem)


def join_problems(*problems: str | None) -> str | None:
    """Join messages in order, skipping those that a later one contains; None if there are none."""
    texts = [problem for problem in problems if problem]
    distinct_texts = [text for i, text in enumerate(texts) if not any(text in later for later in texts[i + 1 :])]
    return "; ".join(distinct_texts) or None
