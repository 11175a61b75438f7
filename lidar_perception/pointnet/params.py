"""Parameters of the detector: flags, ROS parameters and docs are made from these fields."""

from __future__ import annotations

from dataclasses import dataclass

from lidar_perception.detection.detector_params import NetworkParams
from lidar_perception.param_fields import param
from lidar_perception.params import ClusteringParams, GroundParams, InputParams
from lidar_perception.pointnet.config import PointNetConfig

STEPS = ("preprocess", "ground", "clustering", "network", "postprocess")  # each has its time


@dataclass(frozen=True)
class PointNetParams(NetworkParams):
    """Which network, where it runs, which clusters it reads, and what counts as found."""

    least_points: int = param(5, "Clusters of fewer points are left out.", low=1, high=1_000_000)


INPUT = InputParams()
GROUND, CLUSTERING = PointNetConfig().ground, PointNetConfig().clustering


@dataclass(frozen=True)
class PointNetDetectorParams:
    """All groups of the detector."""

    input: InputParams = INPUT
    ground: GroundParams = GROUND
    clustering: ClusteringParams = CLUSTERING
    pointnet: PointNetParams = PointNetParams()
