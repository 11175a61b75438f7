"""Parameters of the detector: flags, ROS parameters and docs are made from these fields."""

from __future__ import annotations

from dataclasses import dataclass

from lidar_perception.clustering.params import ClusteringParams
from lidar_perception.detectors.params import NetworkParams, make_on_points_param
from lidar_perception.detectors.pointnet.config import PointNetConfig
from lidar_perception.ground.params import GroundParams
from lidar_perception.param_fields import param
from lidar_perception.robot.params import CropParams
from lidar_perception.wire.params import InputParams

STEPS = ("preprocess", "ground", "clustering", "network", "postprocess")  # each has its time


@dataclass(frozen=True)
class PointNetParams(NetworkParams):
    """Which network, where it runs, which clusters it reads, and what counts as a detection."""

    min_points: int = param(3, "Clusters of fewer points are left out.", low=1, high=1_000_000)
    max_clusters: int = param(4000, "Clusters that are looked at, the nearest first; a scan has "
                              "some hundred. The diagnostics say how many are left out.", low=1,
                              high=1_000_000)
    on_points: float = make_on_points_param()
    engine: str = param("auto", "What runs the network on the CPU. torch: torch. auto: compiled "
                        "kernels on x86-64 with AVX2, otherwise torch. Detections are the same.",
                        choices=("auto", "torch"), fixed=True)


INPUT = InputParams()
GROUND, CLUSTERING = PointNetConfig().ground, PointNetConfig().clustering


@dataclass(frozen=True)
class PointNetDetectorParams:
    """All groups of the detector."""

    input: InputParams = INPUT
    crop: CropParams = CropParams()
    ground: GroundParams = GROUND
    clustering: ClusteringParams = CLUSTERING
    pointnet: PointNetParams = PointNetParams()
