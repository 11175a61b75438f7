"""Parameters of PointNet, the source of ROS parameters, command line options and docs."""

from __future__ import annotations

from dataclasses import dataclass

from lidar_perception.clustering.params import ClusteringParams
from lidar_perception.detectors.params import NetworkParams, make_on_points_param
from lidar_perception.detectors.pointnet.config import PointNetConfig
from lidar_perception.ground.params import GroundParams
from lidar_perception.param_fields import param
from lidar_perception.robot.params import CropParams
from lidar_perception.wire.params import InputParams

STEPS = ("preprocess", "ground", "clustering", "network", "postprocess")  # keys of the timings


@dataclass(frozen=True)
class PointNetParams(NetworkParams):
    """Network, device, clusters and thresholds of PointNet."""

    min_points: int = param(3, "Ignore clusters with fewer points.", low=1, high=1_000_000)
    max_clusters: int = param(
        4000,
        "Maximum number of clusters. The nearest ones are kept, and the diagnostics report how many are ignored. A "
        "typical scan has a few hundred.",
        low=1,
        high=1_000_000,
    )
    on_points: float = make_on_points_param()
    engine: str = param(
        "auto",
        "Implementation of the network on the CPU. auto: compiled kernels on x86-64 with AVX2, otherwise torch. torch: "
        "always torch. Detections are the same.",
        choices=("auto", "torch"),
        fixed=True,
    )


@dataclass(frozen=True)
class PointNetDetectorParams:
    """All parameter groups of PointNet."""

    input: InputParams = InputParams()
    crop: CropParams = CropParams()
    ground: GroundParams = PointNetConfig().ground
    clustering: ClusteringParams = PointNetConfig().clustering
    pointnet: PointNetParams = PointNetParams()
