"""Parameters of PointPillars, the source of ROS parameters, command line options and docs."""

from __future__ import annotations

from dataclasses import dataclass

from lidar_perception.clustering.params import FULL_DENSITY, ClusteringParams, DbscanParams
from lidar_perception.detectors.params import NetworkParams, make_amp_param, make_engine_param, make_range_param
from lidar_perception.ground.params import GroundParams
from lidar_perception.param_fields import param
from lidar_perception.robot.params import CropParams
from lidar_perception.wire.params import InputParams

STEPS = ("preprocess", "experts", "network", "postprocess")  # keys of the timings


@dataclass(frozen=True)
class PointPillarsParams(NetworkParams):
    """Network, device and thresholds of PointPillars."""

    weights: str = param(
        "", "Checkpoint (.safetensors) or exported network (.onnx); empty: the shipped checkpoint.", fixed=True
    )
    version: str = param(
        "auto",
        "EG-PointPillars version: v0 (PointPillars), v1 ... v4. auto: the version of the weights, by default v4.",
        choices=("auto", "v0", "v1", "v2", "v3", "v4"),
        fixed=True,
    )
    size: str = param(
        "auto",
        "full: the paper's network, for a GPU. compact: for two CPU cores. auto: the size of the weights, by default "
        "compact.",
        choices=("auto", "full", "compact"),
        fixed=True,
    )
    range: str = make_range_param()
    amp: str = make_amp_param()
    engine: str = make_engine_param()


# Paper B uses Patchwork++ and DBSCAN as experts but does not state their parameters. These were
# chosen on simulated scans so that a car is one cluster; paper A's parameters, which are meant for
# pedestrians, split cars.
EXPERT_GROUND = GroundParams(method="patchwork")
EXPERT_CLUSTERING = ClusteringParams(density=FULL_DENSITY, dbscan=DbscanParams(eps=(0.5, 0.7, 1.0), min_samples=5))


@dataclass(frozen=True)
class DetectorParams:
    """All parameter groups of PointPillars. `ground` and `clustering` configure its experts."""

    input: InputParams = InputParams()
    crop: CropParams = CropParams()
    ground: GroundParams = EXPERT_GROUND
    clustering: ClusteringParams = EXPERT_CLUSTERING
    pointpillars: PointPillarsParams = PointPillarsParams()
