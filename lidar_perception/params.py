"""The parameters of the nodes, composed of the groups that lie beside each algorithm.

A number lives once, in the params.py of its room: one frozen dataclass an algorithm. From its
fields come the ROS parameter declarations with their descriptors, the check of YAML files, the
command-line flags and the tables in docs/. A value outside its range raises ValueError when the
dataclass is made, with the name, the value and the range in the message.
"""

from __future__ import annotations

from dataclasses import dataclass

from lidar_perception.candidates.params import (
    ConfidenceParams,
    CpaParams,
    HeightParams,
    ResolutionParams,
    SeedParams,
    StmParams,
)
from lidar_perception.clustering.params import BoxParams, ClusteringParams
from lidar_perception.ground.params import GroundParams, ObstacleParams
from lidar_perception.param_fields import Params, param
from lidar_perception.robot.params import CropParams
from lidar_perception.tracking.params import EgoParams, TrackingParams
from lidar_perception.wire.params import InputParams, ViewParams


@dataclass(frozen=True)
class ReceptionParams(Params):
    """How a node takes its clouds, and from when on it says that something is wrong with them."""

    reliability: str = param(
        "auto", "auto: reliable where every publisher of the topic offers it, else best_effort. "
        "qos_overrides.TOPIC.subscription.reliability stands above this.",
        choices=("auto", "reliable", "best_effort"))
    queue: int = param(1, "Clouds that wait while one is worked on; older ones are dropped, and "
                          "counted. 1: the newest wins.", low=1, high=1000)
    max_wait: float = param(10.0, "A cloud that needs what has not come yet, such as the camera's "
                            "calibration with view.enabled, or a transform of its time, waits for "
                            "this time.", unit="s", low=0.0, high=3600.0)
    rate: float = param(0.0, "Clouds a second that the sensor sends; 0 takes what the first 21 "
                        "say.", unit="Hz", low=0.0, high=1000.0)
    min_rate: float = param(0.7, "WARN below this share of the rate.", low=0.0, high=1.0)
    error_after: float = param(2.0, "ERROR when no cloud has come for this time, and for three "
                               "periods of the rate.", unit="s", low=0.1, high=1e6)
    stale_after: float = param(10.0, "STALE when no cloud has come for this time, and for six "
                               "periods of the rate.", unit="s", low=0.1, high=1e6)
    max_lost: float = param(0.02, "WARN when more than this share of the last 100 clouds was lost "
                            "on the way.", low=0.0, high=1.0)
    max_dropped: float = param(
        0.5, "WARN when more than this share of the last 100 clouds was dropped because a newer "
        "one came before its turn.", low=0.0, high=1.0)
    deskew: str = param(
        "off", "Motion correction: points are moved to header.stamp, by the cloud's column of "
        "times and, odometry: ~/input/odometry (nav_msgs/Odometry), or tf: TF, from "
        "`input.fixed_frame`. off: they are used as they are.", choices=("off", "odometry", "tf"),
        fixed=True)
    fixed_frame: str = param("odom", "For `input.deskew` and `ego.source` tf: a frame in which the "
                             "robot moves without jumps.", fixed=True)
    ahead: float = param(0.0, "Where the detectors look: degrees from the clouds' x axis, "
                         "counter-clockwise, 90 where y looks ahead. What goes out stays in the "
                         "cloud's frame.", unit="deg", low=-180.0, high=360.0, fixed=True)


@dataclass(frozen=True)
class MarkerParams(Params):
    """Boxes for RViz and Foxglove."""

    marker_lifetime: float = param(2.0, "Markers go away when no newer ones have come for this "
                                   "time, and for 2.5 periods of the rate (`input.rate`), as of a "
                                   "node that has died; 0 keeps them for ever.",
                                   unit="s", low=0.0, high=1e6)


@dataclass(frozen=True)
class TrackMarkerParams(MarkerParams):
    """Boxes, and the ways of tracks."""

    trail: float = param(2.0, "The way of a track is drawn for this time; 0 draws none.", unit="s",
                         low=0.0, high=60.0)


@dataclass(frozen=True)
class OptionalTracking(TrackingParams):
    """Tracks in one process with a detector."""

    enabled: bool = param(False, "Publish tracks of what is detected, too, on ~/output/tracks.",
                          fixed=True)


@dataclass(frozen=True)
class CloudNodeParams(Params):
    """What a node that takes clouds has besides the numbers of its algorithm."""

    input: ReceptionParams = ReceptionParams()
    base_frame: str = param("", "A frame on the ground, such as base_footprint: height, roll and "
                            "pitch of the sensor come from TF instead of ground.sensor_pose, and "
                            "all is computed on the levelled cloud. Empty: off.", fixed=True)
    autostart: bool = param(True, "Configure and activate at the start. false: a lifecycle manager "
                            "does, as Nav2's, or `ros2 lifecycle`.", fixed=True)


@dataclass(frozen=True)
class BoxNodeParams(CloudNodeParams):
    """What a node that makes boxes of clouds has besides the numbers of its algorithm."""

    output: MarkerParams = MarkerParams()
    target_frame: str = param("", "The frame of the boxes that go out, by TF at the stamp of their "
                              "cloud. Empty: the cloud's.", fixed=True)


@dataclass(frozen=True)
class GroundRobotParams(CloudNodeParams):
    """What ground_segmentation has besides."""

    obstacles: ObstacleParams = ObstacleParams()


@dataclass(frozen=True)
class DetectionNodeParams(BoxNodeParams):
    """What a node that detects objects in clouds has besides."""

    output: TrackMarkerParams = TrackMarkerParams()
    tracking: OptionalTracking = OptionalTracking()
    ego: EgoParams = EgoParams()


@dataclass(frozen=True)
class PerceptionRobotParams(DetectionNodeParams):
    """What perception has besides."""

    obstacles: ObstacleParams = ObstacleParams()


@dataclass(frozen=True)
class TrackInputParams(CloudNodeParams):
    """What the tracker has besides its numbers. Each detection counts, so some may wait."""

    input: ReceptionParams = ReceptionParams(queue=10)
    output: TrackMarkerParams = TrackMarkerParams()


# Each node declares the groups of its own stages, under the same names.


@dataclass(frozen=True)
class GroundNodeParams:
    input: InputParams = InputParams()
    crop: CropParams = CropParams()
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
class TrackerNodeParams:
    tracking: TrackingParams = TrackingParams()
    ego: EgoParams = EgoParams()


@dataclass(frozen=True)
class PlayerParams(Params):
    """Replay of a bag."""

    bag: str = param("", "Folder of the bag, or one .mcap or .db3 file, or .bag of ROS 1.",
                     fixed=True)
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
        str, "Topics that must have a subscriber before the first message, or several: "
        "TOPIC:=COUNT. Topics of other nodes may be named too. Empty: the bag's clouds.",
        fixed=True)
    follow: tuple[str, ...] = param(
        str, "Topics of detections (MarkerArray): the next cloud is sent when those before have "
        "their answer on each, so that none is lost; the bag's time stands still meanwhile. Empty "
        "plays in real time, as a sensor sends.", fixed=True)
    ahead: int = param(1, "Clouds without an answer at a time, with `follow`. The nodes must have "
                          "an `input.queue` as long, or they drop some. 0: play in real time; the "
                          "answers are only timed.", low=0, high=1000, fixed=True)
    follow_timeout: float = param(10.0, "Go on without an answer after this time, and count it.",
                                  unit="s", low=0.1, high=3600.0, fixed=True)
    wait_timeout: float = param(10.0, "Play without subscribers after this time; 0 does not wait.",
                                unit="s", low=0.0, high=3600.0, fixed=True)


@dataclass(frozen=True)
class RecorderParams(Params):
    """Recording of topics to a rosbag2 bag."""

    bag: str = param("", "Folder to make for the bag.", fixed=True)
    topics: tuple[str, ...] = param(str, "Topics to record.", fixed=True)
    compression: str = param("zstd", "Compression of the bag: zstd (level 1), lz4, or none, which "
                             "takes the least CPU time and the most disk.",
                             choices=("zstd", "lz4", "none"), fixed=True)


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
                                        "truth (protocol of the STM-CPA paper).")
