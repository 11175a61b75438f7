"""Parameters of the detector: flags, ROS parameters and docs are made from these fields."""

from __future__ import annotations

from dataclasses import dataclass

from lidar_perception.candidates.configurations import BEST
from lidar_perception.clustering.params import ClusteringParams
from lidar_perception.detectors.params import (
    NetworkParams,
    NmsParams,
    layers_format,
    network_engine,
    seen_range,
    share_on_points,
)
from lidar_perception.detectors.pointpillars.params import EXPERT_CLUSTERING, EXPERT_GROUND
from lidar_perception.ground.params import GroundParams
from lidar_perception.param_fields import param
from lidar_perception.robot.params import CropParams
from lidar_perception.wire.params import InputParams

STEPS = ("preprocess", "ground", "proposals", "evidence", "fusion")


@dataclass(frozen=True)
class FusedParams(NetworkParams):
    """What proposes, what judges, and what counts as a detection. A score is the probability that
    the object is there."""

    weights: str = param("", "File of `train fused`, which names both networks; a checkpoint of "
                         "PointPillars; or a class of your own, module:Class. Empty: what comes "
                         "with the package.", fixed=True)

    classifier: str = param("", "Checkpoint of the cluster network; empty: the one that comes with "
                            "the package.", fixed=True)
    range: str = seen_range()
    amp: str = layers_format()
    engine: str = network_engine(" torch also runs the cluster network in torch, which otherwise "
                                 "runs in compiled kernels.")
    proposals: float = param(0.02, "Least score of PointPillars for a box to be looked at.",
                             low=0.001, high=1.0)
    max_proposals: int = param(200, "Boxes of PointPillars that are looked at, those with its "
                                    "highest scores.", low=1, high=10_000)
    nms: NmsParams = NmsParams(candidates=1000)
    same_place: float = param(0.6, "People, and cyclists, whose centres are nearer than this are "
                                   "one.", unit="m", low=0.0, high=10.0)
    same_car: float = param(0.02, "Cars that overlap by more than this, seen from above, are one.",
                            low=0.0, high=1.0)
    classifier_box: float = param(0.5, "How far boxes become those that the cluster network makes "
                                       "out of the points in them; 0: PointPillars' own.", low=0.0,
                                  high=1.0)
    on_ground: float = param(0.25, "How far boxes are moved to the ground that is seen around "
                             "them; 0: not at all, 1: onto it.", low=0.0, high=1.0)
    on_points: float = share_on_points()


@dataclass(frozen=True)
class FusedDetectorParams:
    """All groups of the detector; ground is for all its parts, clustering draws PointPillars' map,
    and people are looked for among clusters of their own."""

    input: InputParams = InputParams()
    crop: CropParams = CropParams()
    ground: GroundParams = EXPERT_GROUND
    clustering: ClusteringParams = EXPERT_CLUSTERING
    people: ClusteringParams = BEST.clustering
    fused: FusedParams = FusedParams()
