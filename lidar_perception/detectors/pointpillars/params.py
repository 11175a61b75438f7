"""Parameters of the detector: flags, ROS parameters and docs are made from these fields."""

from __future__ import annotations

from dataclasses import dataclass

from lidar_perception.clustering.params import FULL_DENSITY, ClusteringParams, DbscanParams
from lidar_perception.detectors.params import (
    NetworkParams,
    make_amp_param,
    make_engine_param,
    make_range_param,
)
from lidar_perception.ground.params import GroundParams
from lidar_perception.param_fields import param
from lidar_perception.robot.params import CropParams
from lidar_perception.wire.params import InputParams

STEPS = ("preprocess", "experts", "network", "postprocess")  # of which each has its time


@dataclass(frozen=True)
class PointPillarsParams(NetworkParams):
    """Which PointPillars, where it runs, and what counts as a detection."""

    weights: str = param("", "Checkpoint (.safetensors) or exported network (.onnx); empty: the "
                         "one that comes with the package.", fixed=True)
    version: str = param("auto", "EG-PointPillars version: v0 (PointPillars), v1 ... v4. auto: "
                         "what the weights are; v4 without weights.",
                         choices=("auto", "v0", "v1", "v2", "v3", "v4"), fixed=True)
    size: str = param("auto", "full: the paper's network, for a GPU. compact: for two CPU cores. "
                      "auto: what the weights are; compact without weights.",
                      choices=("auto", "full", "compact"), fixed=True)
    range: str = make_range_param()
    amp: str = make_amp_param()
    engine: str = make_engine_param()


# The experts of paper B: Patchwork++ and DBSCAN, of which it gives no numbers. Ours, chosen on
# simulated scans, keep cars in one piece; paper A's, which are for pedestrians, break them up.
EXPERT_GROUND = GroundParams(method="patchwork")
EXPERT_CLUSTERING = ClusteringParams(density=FULL_DENSITY, dbscan=DbscanParams(
    eps=(0.5, 0.7, 1.0), min_samples=5))
INPUT = InputParams()


@dataclass(frozen=True)
class DetectorParams:
    """All groups of the detector; ground and clustering are its experts."""

    input: InputParams = INPUT
    crop: CropParams = CropParams()
    ground: GroundParams = EXPERT_GROUND
    clustering: ClusteringParams = EXPERT_CLUSTERING
    pointpillars: PointPillarsParams = PointPillarsParams()
