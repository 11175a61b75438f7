"""Every number of this package, once.

One frozen dataclass an algorithm. From these fields come the ROS parameter declarations with
their descriptors, the check of YAML files, the command-line flags and the tables in docs/.
A value outside its range raises ValueError when the dataclass is made, with the name, the value
and the range in the message.
"""

from __future__ import annotations

from dataclasses import dataclass

from lidar_perception.param_fields import (
    MAX_INT,
    Params,
    flatten,
    param,
    parameter_fields,
    with_values,
)

__all__ = ["Params", "flatten", "parameter_fields", "with_values"]


@dataclass(frozen=True)
class InputParams(Params):
    """How to read the fields of a cloud."""

    intensity_max: float = param(
        0.0, "The intensity of a full reflection: 1 for KITTI, 255 for Velodyne and nuScenes. 0 "
        "takes the largest value of an integer field, and 1 for a float field.",
        low=0.0, high=1e9)


@dataclass(frozen=True)
class ViewParams(Params):
    """Crop to the camera's field of view (paper A, Section 3.2)."""

    enabled: bool = param(
        False, "Keep only the points that the camera sees. Needs the camera's calibration: "
        "CameraInfo and the transform from the LiDAR, both latched.")


@dataclass(frozen=True)
class SensorPoseParams(Params):
    """How the sensor is mounted. The algorithms see the levelled cloud; nothing that is published
    moves."""

    height: float = param(1.73, "Height of the sensor above the ground. Checked against the first "
                          "clouds; a warning gives the measured one.", unit="m",
                          low=0.0, high=50.0)
    roll: float = param(0.0, "Rotation of the sensor about its x axis, as in a URDF's rpy; pi is "
                        "upside down.", unit="rad", low=-3.1416, high=3.1416)
    pitch: float = param(0.0, "Rotation of the sensor about its y axis, as in a URDF's rpy; "
                         "positive looks down.", unit="rad", low=-1.58, high=1.58)


@dataclass(frozen=True)
class ThresholdParams(Params):
    """Height threshold and RANSAC plane (paper A, Sections 3.2 and 3.4, Table 2)."""

    max_height: float = param(0.43, "The plane is looked for among points lower than this above "
                              "the ground at the sensor. 0.43 m under a sensor 1.73 m high is the "
                              "paper's z < -1.3.", unit="m", low=-10.0, high=100.0)
    inlier_distance: float = param(0.1, "A point this near the plane, vertically, is ground.",
                                   unit="m", low=0.001, high=2.0)
    max_iterations: int = param(2000, "RANSAC trials at most; it stops as soon as another trial "
                                "would hardly help.", low=1, high=100_000)
    max_slope: float = param(30.0, "Planes steeper than this are not ground.", unit="deg",
                             low=0.0, high=89.0)
    seed: int = param(0, "Seed of the random trials.", low=0, high=MAX_INT)


@dataclass(frozen=True)
class PatchworkParams(Params):
    """Patchwork++: a plane in each sector of concentric zones (Lee et al., IROS 2022)."""

    min_range: float = param(2.7, "Points nearer than this are not ground.", unit="m",
                             low=0.0, high=50.0)
    max_range: float = param(80.0, "Points farther than this are not ground.", unit="m",
                             low=5.0, high=1000.0)
    inlier_distance: float = param(0.125, "A point this near its sector's plane is ground.",
                                   unit="m", low=0.001, high=2.0)
    seed_distance: float = param(0.125, "Points this far above the lowest ones start the plane of "
                                 "a sector.", unit="m", low=0.001, high=2.0)
    uprightness: float = param(0.707, "Least z of the normal of a ground plane; 0.707 is 45 "
                               "degrees.", low=0.0, high=1.0)
    remove_reflections: bool = param(True, "Leave out points below the ground that come from "
                                     "reflections (RNR). Needs intensity.")

    def check(self) -> None:
        if self.max_range <= self.min_range:
            raise ValueError(f"max_range = {self.max_range} must be above min_range = "
                             f"{self.min_range}")


@dataclass(frozen=True)
class ClothParams(Params):
    """Cloth simulation (paper C, Eq. 2 and 3; Zhang et al., Remote Sensing 2016)."""

    resolution: float = param(0.5, "Distance of the cloth's particles.", unit="m",
                              low=0.1, high=10.0)
    max_range: float = param(100.0, "Half the side of the cloth; points beyond it are not ground.",
                             unit="m", low=1.0, high=500.0)
    class_threshold: float = param(0.2, "A point this near the cloth, vertically, is ground.",
                                   unit="m", low=0.001, high=5.0)
    curvature: float = param(0.1, "How sharply gravity bends the cloth where nothing holds it; "
                             "less is stiffer.", unit="1/m", low=0.0001, high=10.0)

    slope: float = param(0.08, "Where the ground climbs faster than the cloth can bend, it goes on "
                         "from what the cloth touches with a slope of up to this; 0: it does not.",
                         low=0.0, high=2.0)

    def check(self) -> None:
        if (cells := (2 * self.max_range / self.resolution) ** 2) > 4_000_000:
            raise ValueError(f"resolution = {self.resolution} m over max_range = {self.max_range} "
                             f"m makes {cells:.0f} particles, more than 4 million; raise the one "
                             "or lower the other")


GROUND_METHODS = ("threshold", "patchwork", "cloth")


@dataclass(frozen=True)
class GroundParams(Params):
    """Which points are ground."""

    method: str = param("threshold", "threshold: one plane (paper A). patchwork: Patchwork++ "
                        "(paper B). cloth: cloth simulation (paper C).", choices=GROUND_METHODS)
    sensor_pose: SensorPoseParams = SensorPoseParams()
    threshold: ThresholdParams = ThresholdParams()
    patchwork: PatchworkParams = PatchworkParams()
    cloth: ClothParams = ClothParams()


@dataclass(frozen=True)
class DbscanParams(Params):
    """Distance-aware DBSCAN (paper A, Section 3.3, Table 2)."""

    range_limits: tuple[float, ...] = param(
        (15.0, 30.0), "Horizontal ranges at which eps changes, ascending.", unit="m",
        low=0.0, high=1e6)
    eps: tuple[float, ...] = param(
        (0.15, 0.30, 0.50), "Neighbourhood radius in each range band, one more than range_limits.",
        unit="m", low=0.001, high=100.0)
    min_samples: int = param(10, "Points within eps, itself included, that make a core point.",
                             low=1, high=MAX_INT)
    join_bands: bool = param(False, "Join clusters across a range limit where core points of both "
                             "lie within the smaller eps; the paper cuts them there.")

    def check(self) -> None:
        if len(self.eps) != len(self.range_limits) + 1:
            raise ValueError(f"eps has {len(self.eps)} values for {len(self.range_limits)} "
                             "range_limits; give one more eps than range_limits")
        if any(b <= a for a, b in zip(self.range_limits, self.range_limits[1:])):
            raise ValueError(f"range_limits = {list(self.range_limits)} must ascend")


@dataclass(frozen=True)
class EuclideanParams(Params):
    """Adaptive Euclidean clustering (paper C, Eq. 6 to 11)."""

    threshold: str = param("local", "global: one distance for the whole cloud (Eq. 6). local: one "
                           "for each point, from its neighbours (Eq. 11). fixed: `distance`.",
                           choices=("global", "local", "fixed"))
    distance: float = param(0.5, "The threshold, if it is fixed.", unit="m", low=0.001, high=10.0)
    alpha: float = param(1.2, "Factor of the distance threshold (Eq. 6 and 11).",
                         low=0.01, high=100.0)
    beta: float = param(0.5, "MinPts = beta ln N: points within the threshold, itself included, "
                        "from which a point makes others follow (Eq. 7).", low=0.0, high=1000.0)
    gamma: float = param(0.8, "Clusters are merged when their centres are nearer than gamma times "
                         "the mean of their diameters (Eq. 9); 0 merges none.", low=0.0, high=10.0)
    radius: float = param(0.5, "Neighbours for the local threshold lie within this radius.",
                          unit="m", low=0.001, high=10.0)
    min_size: int = param(10, "Smaller clusters are dropped.", low=1, high=MAX_INT)


CLUSTERING_METHODS = ("dbscan", "euclidean")


@dataclass(frozen=True)
class ClusteringParams(Params):
    """Which points that are not ground belong together."""

    method: str = param("dbscan", "dbscan: distance-aware DBSCAN (paper A). euclidean: adaptive "
                        "Euclidean clustering (paper C).", choices=CLUSTERING_METHODS)
    dbscan: DbscanParams = DbscanParams()
    euclidean: EuclideanParams = EuclideanParams()


BOX_SHAPES = ("axis_aligned", "min_area", "l_shape")


@dataclass(frozen=True)
class BoxParams(Params):
    """Boxes of clusters."""

    shape: str = param("axis_aligned", "axis_aligned: along x and y (paper A). min_area: the "
                       "smallest rectangle. l_shape: along the two visible sides.",
                       choices=BOX_SHAPES)


@dataclass(frozen=True)
class HeightParams(Params):
    """Height filter (paper A, Section 3.5)."""

    tolerance: float = param(0.2, "A candidate's height may differ this much from the seed's.",
                             unit="m", low=0.0, high=100.0)


@dataclass(frozen=True)
class ResolutionParams(Params):
    """How densely the sensor samples; 0.43 and 0.17 degrees are the HDL-64E's of KITTI."""

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
    steps: int = param(2, "Contracted copies of the cluster that are added; 0 adds none.",
                       low=0, high=100)
    decrement: float = param(0.10, "Scale lost with each copy.", low=0.0, high=1.0)
    min_scale: float = param(0.20, "Smallest scale of a copy.", low=0.0, high=1.0)


@dataclass(frozen=True)
class ConfidenceParams(Params):
    """A probability for each candidate from its shape and its likeness to the seed."""

    enabled: bool = param(False, "Accept by confidence instead of by similarity alone, and give "
                          "it as the score.")
    threshold: float = param(0.5, "Least confidence of a candidate.", low=0.0, high=1.0)


SEED_SOURCES = ("ground_truth", "click", "file", "automatic")


@dataclass(frozen=True)
class SeedParams(Params):
    """Where the seed pedestrian comes from (paper A, Section 3.5)."""

    source: str = param(
        "file", "ground_truth: nearest Pedestrian of the frame's labels (the paper's protocol). "
        "click: the cluster at /clicked_point. file: a saved template. automatic: the cluster of "
        "the frame that is most like a pedestrian, or the template where none is.",
        choices=SEED_SOURCES)
    file: str = param("", "Template file for source 'file'; empty: the one that comes with the "
                      "package.")
    least_confidence: float = param(0.3, "For source 'automatic': a cluster less like a pedestrian "
                                    "than this is no seed.", low=0.0, high=1.0)
    click_radius: float = param(2.0, "A click takes the nearest cluster within this distance.",
                                unit="m", low=0.01, high=100.0)


# The steps of the candidate pipeline whose times are taken, in order.
STEPS = ("view", "ground", "clustering", "boxes", "height", "stm", "cpa", "confidence")


@dataclass(frozen=True)
class PipelineParams:
    """All groups of the candidate pipeline, in the order of the stages."""

    input: InputParams = InputParams()
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


# Each node declares the groups of its own stages, under the same names.


@dataclass(frozen=True)
class GroundNodeParams:
    input: InputParams = InputParams()
    view: ViewParams = ViewParams()
    ground: GroundParams = GroundParams()


@dataclass(frozen=True)
class ClusteringNodeParams:
    clustering: ClusteringParams = ClusteringParams()
    boxes: BoxParams = BoxParams()


@dataclass(frozen=True)
class RefinementNodeParams:
    boxes: BoxParams = BoxParams()
    height: HeightParams = HeightParams()
    stm: StmParams = StmParams()
    cpa: CpaParams = CpaParams()
    resolution: ResolutionParams = ResolutionParams()
    confidence: ConfidenceParams = ConfidenceParams()
    seed: SeedParams = SeedParams()


@dataclass(frozen=True)
class PlayerParams(Params):
    """Replay of a rosbag2 bag."""

    bag: str = param("", "Folder of the bag, or one .mcap or .db3 file.", fixed=True)
    rate: float = param(1.0, "Speed of the replay; 2.0 is twice as fast as recorded.",
                        low=0.01, high=100.0)
    loop: bool = param(False, "Start again at the end.")
    start_offset: float = param(0.0, "Skip this much of the bag. Latched topics are replayed "
                                "all the same.", unit="s", low=0.0, fixed=True)
    duration: float = param(0.0, "Play this much of the bag; 0 plays all.", unit="s", low=0.0,
                            fixed=True)
    start_paused: bool = param(False, "Wait for ~/resume or ~/step before the first message.",
                               fixed=True)
    topics: tuple[str, ...] = param(str, "Topics to play; empty plays all.", fixed=True)
    remap: tuple[str, ...] = param(str, "Topics to rename, each as OLD:=NEW.", fixed=True)
    clock_hz: float = param(0.0, "Publish the bag's time on /clock this often; 0 does not.",
                            unit="Hz", low=0.0, high=1000.0, fixed=True)
    wait_for: tuple[str, ...] = param(
        ("/points",), "Topics that must have a subscriber before the first message, or several: "
        "TOPIC:=COUNT. Topics of other nodes may be named too.", fixed=True)
    wait_timeout: float = param(10.0, "Play without subscribers after this time; 0 does not wait.",
                                unit="s", low=0.0, high=3600.0, fixed=True)


@dataclass(frozen=True)
class RecorderParams(Params):
    """Recording of topics to a rosbag2 bag."""

    bag: str = param("", "Folder to make for the bag.", fixed=True)
    topics: tuple[str, ...] = param(str, "Topics to record.", fixed=True)


@dataclass(frozen=True)
class EvaluatorParams(Params):
    """Scores of detections against ground truth."""

    stages: tuple[str, ...] = param(("final",), "Inputs to score; each NAME is the topic "
                                    "~/input/NAME.", fixed=True)
    timing: tuple[str, ...] = param(str, "Topics with times in ms (std_msgs/Float64) to take the "
                                    "median of.", fixed=True)
    file: str = param("", "Write the scores to this JSON file at the end and every few seconds; "
                      "empty writes none.", fixed=True)
    only_with_pedestrians: bool = param(True, "Score only frames with a Pedestrian in the ground "
                                        "truth (paper A's protocol).")
