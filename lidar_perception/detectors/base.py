"""The base class of detectors with networks: input checks, cropping and parameters."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Self

import numpy as np

from lidar_perception.detectors.contract import Cloud, DetectionResult, check_input, join_problems
from lidar_perception.detectors.params import ConfiguredDetector, NetworkParams
from lidar_perception.detectors.trained_network import TrainedNetwork
from lidar_perception.ground.params import SensorPoseParams
from lidar_perception.ground.segment import crop_with_sensor_pose
from lidar_perception.types import SENSOR_HEIGHT, InputError, PointCloud


class NetworkDetector(ConfiguredDetector):
    """Base class of detectors with neural networks; their own parameters are NetworkParams.

    Attributes:
        warning: reason why scores are unreliable or classes are never detected, or None.
    """

    def __init__(self, params: Any, warning: str | None = None):
        self.params, self.warning = params, warning

    @property
    def networks(self) -> tuple[TrainedNetwork, ...]:
        """The networks; the first one determines classes and range."""
        raise NotImplementedError

    def __call__(
        self, cloud: Cloud, *, ground: np.ndarray | None = None, cluster_ids: np.ndarray | None = None
    ) -> DetectionResult:
        """Detect the objects in a cloud, see contract.Detector.

        Raises:
            InputError: bad input, or CUDA is out of memory and the parameter cpu_fallback is off.
        """
        frame, ground, cluster_ids, problem = check_input(cloud, ground, cluster_ids, self.settings.use_intensity)
        if self.params.crop.enabled:
            indices, frame = crop_with_sensor_pose(frame, self.params.crop, self.params.ground.sensor_pose)
            ground, cluster_ids = (
                column if column is None else column.take(indices) for column in (ground, cluster_ids)
            )
        result = self.detect(frame, ground, cluster_ids)
        return replace(result, problem=join_problems(problem, result.problem)) if problem else result

    def detect(self, frame: PointCloud, ground: np.ndarray | None, cluster_ids: np.ndarray | None) -> DetectionResult:
        """Detect the objects in a checked and cropped frame."""
        raise NotImplementedError

    @property
    def settings(self) -> NetworkParams:
        return super().settings

    @property
    def device(self) -> str:
        """Current device of the first network: cpu, cuda or cuda:N."""
        return self.networks[0].device

    @property
    def fallback(self) -> str | None:
        """Reason why a network runs on the CPU instead of the chosen device, or None."""
        return next((network.placement.fallback for network in self.networks if network.placement.fallback), None)

    @fallback.setter
    def fallback(self, reason: str | None) -> None:
        self.networks[0].placement.fallback = reason

    @property
    def classes(self) -> tuple[str, ...]:
        return self.networks[0].classes

    @property
    def range(self) -> str:
        """Covered area: "ahead" (in front of the sensor) or "around" (all directions)."""
        low = getattr(self.networks[0].config, "low", None)  # PointNet has no range
        return "around" if low is None or low[0] < 0 else "ahead"

    def with_range(self, range: str) -> Self:
        """Return a copy of this detector with a different range.

        Args:
            range: ahead, around, or auto (the range the network was trained for). PointNet
                always covers all directions.

        Raises:
            InputError: the network cannot cover that range.
        """
        if range == "ahead":
            raise InputError(f"{self.group} always covers all directions; use the parameters crop.* to limit the area")
        return self

    def with_raw_scores(self) -> Self:
        """Return a copy of this detector that reports uncalibrated scores."""
        raise NotImplementedError


def make_synthetic_frame(pose: SensorPoseParams) -> PointCloud:
    """Return flat ground with three objects, a cloud that triggers JIT compilation of every stage."""
    rng = np.random.default_rng(0)
    ground = rng.uniform(0, 40, (2000, 3)) * [1, 1, 0.001] - [0, 20, SENSOR_HEIGHT]
    sparse_object = rng.uniform(-0.5, 0.5, (400, 3)) + [8, 0, -0.8]
    dense_object = rng.uniform(-0.05, 0.05, (2000, 3)) + [8, 4, -0.8]  # DBSCAN has a separate code path for it
    split_object = rng.uniform(-0.3, 0.3, (400, 3)) + [15, 0, -0.8]  # two range bands of DBSCAN meet at 15 m
    xyz = np.concatenate([ground, sparse_object, dense_object, split_object]).astype(np.float32)
    xyz[:, 2] -= pose.height - SENSOR_HEIGHT
    return PointCloud(xyz, rng.uniform(0.1, 0.9, len(xyz)).astype(np.float32))
