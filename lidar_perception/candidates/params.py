"""Parameters of paper A's candidates, and of the whole candidate pipeline."""

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

    tolerance: float = param(0.2, "A candidate's height may differ this much from the seed's.",
                             unit="m", low=0.0, high=100.0)


@dataclass(frozen=True)
class ResolutionParams(Params):
    """Angular resolution of the sensor; the defaults are those of KITTI's HDL-64E."""

    elevation_step: float = param(0.43, "Angle between neighbouring beams.", unit="deg",
                                  low=0.01, high=20.0)
    azimuth_step: float = param(0.17, "Angle between neighbouring points of a beam.", unit="deg",
                                low=0.01, high=20.0)


SILHOUETTE_WINDOWS = ("stretched", "metric")
SILHOUETTE_AXES = ("yaw", "pca")


@dataclass(frozen=True)
class StmParams(Params):
    """Single template matching (paper A, Section 3.6)."""

    threshold: float = param(0.40, "Cosine similarity with the seed's silhouette from which a "
                             "cluster is accepted.", low=0.0, high=1.0)
    window: str = param("stretched", "stretched: the cluster's extent fills the silhouette's "
                        "window. metric: the window is 1.6 m wide and reaches 2.4 m up from the "
                        "ground.", choices=SILHOUETTE_WINDOWS)
    axis: str = param("yaw", "yaw: the cluster is turned about z only. pca: its longest axis "
                      "becomes the vertical, too.", choices=SILHOUETTE_AXES)
    spread: bool = param(False, "Draw every point as large as the part of the surface that it "
                         "stands for (see resolution), so that a silhouette does not depend on "
                         "the range.")
    dilations: int = param(1, "How many times the silhouette is dilated with 3 x 3.",
                           low=0, high=10)
    seen_only: bool = param(False, "With the metric window: compare only what is above the lowest "
                            "point of both the cluster and the seed, as the rest of one of them is "
                            "hidden.")
    shifts: int = param(0, "Columns by which the silhouette may be moved sideways to fit the "
                        "seed's.", low=0, high=16)


@dataclass(frozen=True)
class CpaParams(Params):
    """Centralized point augmentation (paper A, Section 3.7)."""

    min_range: float = param(15.0, "Nearest horizontal range where points are added.", unit="m",
                             low=0.0, high=1e6)
    max_range: float = param(30.0, "Farthest horizontal range where points are added.", unit="m",
                             low=0.0, high=1e6)
    steps: int = param(2, "Number of shrunken copies of the cluster that are added; 0: none.",
                       low=0, high=100)
    decrement: float = param(0.10, "Scale lost with each copy.", low=0.0, high=1.0)
    min_scale: float = param(0.20, "Smallest scale of a copy.", low=0.0, high=1.0)


@dataclass(frozen=True)
class ConfidenceParams(Params):
    """Probability of each candidate, from its shape and its similarity to the seed."""

    enabled: bool = param(False, "Accept by confidence instead of by similarity alone, and give "
                          "it as the score. It was fitted to what the configuration best finds.")
    threshold: float = param(0.5, "Least confidence of a candidate.", low=0.0, high=1.0)


SEED_SOURCES = ("ground_truth", "click", "file", "automatic")


@dataclass(frozen=True)
class SeedParams(Params):
    """Source of the seed pedestrian (paper A, Section 3.5)."""

    source: str = param(
        "file", "ground_truth: nearest Pedestrian of the frame's labels (the paper's protocol). "
        "click: the cluster at /clicked_point. file: a saved template. automatic: the cluster of "
        "the frame that is most like a pedestrian, or the template where none is.",
        choices=SEED_SOURCES)
    file: str = param("", "Template file for source 'file', or several with commas between them; "
                      "empty: the one that comes with the package.")
    bank: int = param(1, "Number of the last clicks whose seeds are kept for source 'click'. A "
                      "cluster is compared with all seeds; the most similar one counts.", low=1,
                      high=16)
    min_confidence: float = param(0.3, "For source 'automatic': a cluster less like a pedestrian "
                                    "than this is no seed.", low=0.0, high=1.0)
    click_radius: float = param(2.0, "A click takes the nearest cluster within this distance.",
                                unit="m", low=0.01, high=100.0)


# The steps of the candidate pipeline whose durations are measured, in order.
STEPS = ("view", "ground", "clustering", "boxes", "height", "stm", "cpa", "confidence")


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
