"""Pedestrian detector that runs the STM-CPA pipeline (paper A)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lidar_perception.camera import Camera
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import find_candidates
from lidar_perception.candidates.seed_sources import SeedSource
from lidar_perception.candidates.segmented_cloud import diagnose_empty
from lidar_perception.detectors.contract import Cloud, DetectionResult, check_input
from lidar_perception.ground.params import set_sensor_height
from lidar_perception.param_fields import with_values
from lidar_perception.types import CLASSES, PEDESTRIAN


@dataclass(frozen=True)
class CandidateDetector:
    """Pedestrian detector with the interface of contract.Detector.

    Attributes:
        seed: source of the seed pedestrian.
        camera: required if params.view is enabled.
    """

    seed: SeedSource
    camera: Camera | None = None
    params: PipelineParams = PipelineParams()

    @property
    def classes(self) -> tuple[str, ...]:
        return (CLASSES[PEDESTRIAN],)

    @property
    def _threshold_param(self) -> str:
        """Name of the parameter with the minimum score of a candidate."""
        return "confidence.threshold" if self.params.confidence.enabled else "stm.threshold"

    @property
    def min_scores(self) -> Mapping[str, float]:
        """Minimum score of a detection, by class."""
        group, name = self._threshold_param.split(".")
        return {self.classes[0]: getattr(getattr(self.params, group), name)}

    def with_min_score(self, min_score: float) -> CandidateDetector:
        """Return a copy of this detector with another threshold."""
        return CandidateDetector(self.seed, self.camera, with_values(self.params, {self._threshold_param: min_score}))

    def with_sensor_height(self, height: float) -> CandidateDetector:
        """Return a copy of this detector for a sensor `height` metres above the ground."""
        return CandidateDetector(self.seed, self.camera, set_sensor_height(self.params, height))

    def __call__(
        self, cloud: Cloud, *, ground: np.ndarray | None = None, cluster_ids: np.ndarray | None = None
    ) -> DetectionResult:
        """Detect pedestrians, see contract.Detector.

        Raises:
            InputError: the input is invalid, there is no seed, or the camera is missing.
        """
        frame, ground, cluster_ids, _ = check_input(cloud, ground, cluster_ids)
        segmented, candidates = find_candidates(
            frame, self.seed, self.camera, self.params, ground=ground, cluster_ids=cluster_ids
        )
        return DetectionResult(
            candidates.final, candidates.ms, diagnose_empty(len(frame), segmented.ground, segmented.cluster_ids)
        )
