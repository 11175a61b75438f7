"""Parameters of the fused detector, the source of ROS parameters, command line options and docs."""

from __future__ import annotations

from dataclasses import dataclass

from lidar_perception.candidates.configurations import BEST
from lidar_perception.clustering.params import ClusteringParams
from lidar_perception.detectors.params import (
    NetworkParams,
    NmsParams,
    make_amp_param,
    make_engine_param,
    make_on_points_param,
    make_range_param,
)
from lidar_perception.detectors.pointpillars.params import EXPERT_CLUSTERING, EXPERT_GROUND
from lidar_perception.ground.params import GroundParams
from lidar_perception.param_fields import param
from lidar_perception.robot.params import CropParams
from lidar_perception.wire.params import InputParams

STEPS = ("preprocess", "ground", "proposals", "evidence", "fusion")  # keys of the timings


@dataclass(frozen=True)
class FusedParams(NetworkParams):
    """Networks, fusion and thresholds. A score is the probability that the object is real."""

    weights: str = param(
        "",
        "Output of `train fused`, which refers to both networks; a PointPillars checkpoint; or your own class, "
        "module:Class. Empty: the shipped weights.",
        fixed=True,
    )

    classifier: str = param("", "Checkpoint of PointNet; empty: the shipped one.", fixed=True)
    range: str = make_range_param()
    amp: str = make_amp_param()
    engine: str = make_engine_param(" torch also runs PointNet in torch instead of compiled kernels.")
    proposals: float = param(0.02, "Minimum PointPillars score of a proposed box.", low=0.001, high=1.0)
    max_proposals: int = param(200, "Maximum number of proposed boxes; the best scores are kept.", low=1, high=10_000)
    nms: NmsParams = NmsParams(candidates=1000)
    same_place: float = param(
        0.6,
        "Two pedestrians or two cyclists whose centres are closer than this are duplicates.",
        unit="m",
        low=0.0,
        high=10.0,
    )
    same_car: float = param(0.02, "Two cars with a bird's-eye-view IoU above this are duplicates.", low=0.0, high=1.0)
    classifier_box: float = param(
        0.5, "Weight of PointNet's box in the result. 0: PointPillars' box, 1: PointNet's box.", low=0.0, high=1.0
    )
    on_ground: float = param(
        0.25, "Move boxes vertically towards the ground. 0: not at all, 1: onto the ground.", low=0.0, high=1.0
    )
    on_points: float = make_on_points_param()


@dataclass(frozen=True)
class FusedDetectorParams:
    """All parameter groups of the detector.

    `ground` applies to all stages, `clustering` to PointPillars' cluster map, and `people` to the
    clusters whose silhouettes are evidence for pedestrians.
    """

    input: InputParams = InputParams()
    crop: CropParams = CropParams()
    ground: GroundParams = EXPERT_GROUND
    clustering: ClusteringParams = EXPERT_CLUSTERING
    people: ClusteringParams = BEST.clustering
    fused: FusedParams = FusedParams()
