"""Parameters of the candidate pipeline of paper A."""

from __future__ import annotations

from dataclasses import dataclass

from lidar_perception.clustering.params import BoxParams, ClusteringParams
from lidar_perception.ground.params import GroundParams
from lidar_perception.param_fields import Params, param
from lidar_perception.robot.params import CropParams
from lidar_perception.wire.params import InputParams, ViewParams


@dataclass(frozen=True)
class HeightParams(Params):
    """Height filter (paper A, Section 3.5)."""

    tolerance: float = param(
        0.2, "Maximum height difference between a candidate and the seed.", unit="m", low=0.0, high=100.0
    )


@dataclass(frozen=True)
class ResolutionParams(Params):
    """Angular resolution of the sensor; defaults for the HDL-64E of KITTI."""

    elevation_step: float = param(0.43, "Angle between neighbouring beams.", unit="deg", low=0.01, high=20.0)
    azimuth_step: float = param(
        0.17, "Angle between neighbouring points of the same beam.", unit="deg", low=0.01, high=20.0
    )


SILHOUETTE_WINDOWS = ("stretched", "metric")
SILHOUETTE_AXES = ("yaw", "pca")


@dataclass(frozen=True)
class StmParams(Params):
    """Single template matching (paper A, Section 3.6)."""

    threshold: float = param(
        0.40, "Minimum cosine similarity between the silhouettes of a cluster and the seed.", low=0.0, high=1.0
    )
    window: str = param(
        "stretched",
        "stretched: silhouettes are stretched to fill the window. metric: the window is 1.6 m wide and 2.4 m high, and "
        "starts at the ground.",
        choices=SILHOUETTE_WINDOWS,
    )
    axis: str = param(
        "yaw",
        "yaw: rotate clusters about z only. pca: also rotate the longest axis to the vertical.",
        choices=SILHOUETTE_AXES,
    )
    spread: bool = param(
        False,
        "Draw every point as large as the surface that it represents (see resolution), so that a silhouette does not "
        "depend on the range.",
    )
    dilations: int = param(1, "Number of 3 x 3 dilations of the silhouette.", low=0, high=10)
    seen_only: bool = param(
        False,
        "With the metric window: compare only the part above the lowest points of both the cluster and the seed, "
        "because one of them is hidden below that height.",
    )
    shifts: int = param(
        0, "Maximum horizontal shift of a silhouette, in columns, to match the seed's silhouette.", low=0, high=16
    )


@dataclass(frozen=True)
class CpaParams(Params):
    """Centralized point augmentation (paper A, Section 3.7)."""

    min_range: float = param(
        15.0, "Minimum horizontal range of clusters that get additional points.", unit="m", low=0.0, high=1e6
    )
    max_range: float = param(
        30.0, "Maximum horizontal range of clusters that get additional points.", unit="m", low=0.0, high=1e6
    )
    steps: int = param(2, "Number of shrunken copies of the cluster that are added; 0: none.", low=0, high=100)
    decrement: float = param(0.10, "Decrease of the scale from copy to copy.", low=0.0, high=1.0)
    min_scale: float = param(0.20, "Minimum scale of a copy.", low=0.0, high=1.0)


@dataclass(frozen=True)
class ConfidenceParams(Params):
    """Confidence: the probability that a candidate is a pedestrian, from its shape and similarity to the seed."""

    enabled: bool = param(
        False,
        "Accept candidates by confidence instead of similarity, and use the confidence as the score. The confidence "
        "was fitted with the configuration best.",
    )
    threshold: float = param(0.5, "Minimum confidence of a candidate.", low=0.0, high=1.0)


SEED_SOURCES = ("ground_truth", "click", "file", "automatic")


@dataclass(frozen=True)
class SeedParams(Params):
    """Source of the seed pedestrian (paper A, Section 3.5)."""

    source: str = param(
        "file",
        "ground_truth: the nearest labelled Pedestrian of the frame (the paper's protocol). click: the cluster at "
        "/clicked_point. file: a saved template. automatic: up to 8 clusters of the frame that PointNet classifies as "
        "pedestrians; without one there are no candidates.",
        choices=SEED_SOURCES,
    )
    file: str = param("", "Template file for source 'file', or several separated by commas; empty: the shipped one.")
    bank: int = param(
        1,
        "For source 'click': number of most recent clicks to keep as seeds. Each cluster is compared with all of them, "
        "and the highest similarity counts.",
        low=1,
        high=16,
    )
    min_confidence: float = param(
        0.5, "For source 'automatic': minimum probability, by PointNet, that a seed is a pedestrian.", low=0.0, high=1.0
    )
    click_radius: float = param(
        2.0, "A click selects the nearest cluster within this distance.", unit="m", low=0.01, high=100.0
    )


STEPS = ("view", "ground", "clustering", "boxes", "height", "stm", "cpa", "confidence")  # keys of the durations


@dataclass(frozen=True)
class PipelineParams:
    """All parameter groups of the candidate pipeline, in the order of the stages."""

    input: InputParams = InputParams()
    crop: CropParams = CropParams()
    view: ViewParams = ViewParams()
    ground: GroundParams = GroundParams()
    clustering: ClusteringParams = ClusteringParams()
    boxes: BoxParams = BoxParams()
    height: HeightParams = HeightParams()
    stm: StmParams = StmParams()
    cpa: CpaParams = CpaParams()
    resolution: ResolutionParams = ResolutionParams()
    confidence: ConfidenceParams = ConfidenceParams()
    seed: SeedParams = SeedParams()
