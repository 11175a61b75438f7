"""Parameters of the nodes, composed of the parameter groups of the algorithms.

Each parameter is defined once, in the params.py of its package, as a field of a frozen dataclass.
The ROS parameters with their descriptors, the checks of YAML files, the command-line flags and the
tables in docs/ are generated from these fields. A value outside its range raises ValueError.
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
from lidar_perception.classes import DETECTED
from lidar_perception.clustering.params import BoxParams, ClusteringParams
from lidar_perception.ground.params import GroundParams, ObstacleParams
from lidar_perception.param_fields import Params, param
from lidar_perception.robot.params import CropParams
from lidar_perception.tracking.params import EgoParams, TrackingParams
from lidar_perception.wire.params import InputParams, ViewParams


@dataclass(frozen=True)
class ReceptionParams(Params):
    """Parameters for receiving clouds, and the limits of the diagnostics."""

    reliability: str = param(
        "auto",
        "auto: reliable if every publisher of the topic offers it, otherwise best_effort. "
        "qos_overrides.TOPIC.subscription.reliability takes precedence.",
        choices=("auto", "reliable", "best_effort"),
    )
    queue: int = param(
        1,
        "Maximum number of clouds that wait while one is processed; older ones are dropped and counted. 1: "
        "only the newest cloud.",
        low=1,
        high=1000,
    )
    max_wait: float = param(
        10.0,
        "Maximum time that a cloud waits for other data, such as a transform or, with view.enabled, the camera "
        "calibration.",
        unit="s",
        low=0.0,
        high=3600.0,
    )
    rate: float = param(
        0.0,
        "Rate of the sensor, clouds per second; 0: measured on the first 21 clouds.",
        unit="Hz",
        low=0.0,
        high=1000.0,
    )
    min_rate: float = param(0.7, "WARN if clouds arrive at less than this fraction of the rate.", low=0.0, high=1.0)
    error_after: float = param(
        2.0,
        "ERROR after this time without a cloud, and at least three periods of the rate.",
        unit="s",
        low=0.1,
        high=1e6,
    )
    stale_after: float = param(
        10.0,
        "STALE after this time without a cloud, and at least six periods of the rate.",
        unit="s",
        low=0.1,
        high=1e6,
    )
    max_lost: float = param(
        0.02, "WARN if more than this fraction of the last 100 clouds was lost in transport.", low=0.0, high=1.0
    )
    max_dropped: float = param(
        0.5,
        "WARN if more than this fraction of the last 100 clouds was dropped in favour of newer ones.",
        low=0.0,
        high=1.0,
    )
    deskew: str = param(
        "off",
        "Motion correction: move points to their position at header.stamp, with the cloud's time column and odometry "
        "(~/input/odometry, nav_msgs/Odometry) or tf (transforms from `input.fixed_frame`). off: no correction.",
        choices=("off", "odometry", "tf"),
        fixed=True,
    )
    fixed_frame: str = param(
        "odom", "For `input.deskew` and `ego.source` tf: a frame in which the robot moves without jumps.", fixed=True
    )
    ahead: float = param(
        0.0,
        "Forward direction of the detectors, measured from the clouds' x axis, counter-clockwise; 90 if y points "
        "forward. Results stay in the cloud's frame.",
        unit="deg",
        low=-180.0,
        high=360.0,
        fixed=True,
    )


@dataclass(frozen=True)
class MarkerParams(Params):
    """Parameters of markers for RViz and Foxglove."""

    marker_lifetime: float = param(
        2.0,
        "Lifetime of markers after their last update, at least 2.5 periods of the rate (`input.rate`), so that the "
        "markers of a dead node disappear; 0: no limit.",
        unit="s",
        low=0.0,
        high=1e6,
    )


@dataclass(frozen=True)
class TrackMarkerParams(MarkerParams):
    """Parameters of markers with boxes and trails of tracks."""

    trail: float = param(2.0, "Duration of the drawn path of a track; 0: no path.", unit="s", low=0.0, high=60.0)


@dataclass(frozen=True)
class OptionalTracking(TrackingParams):
    """Parameters of tracking within a detector node."""

    enabled: bool = param(False, "Also publish tracks of the detections on ~/output/tracks.", fixed=True)


@dataclass(frozen=True)
class CloudNodeParams(Params):
    """Parameters of every node that receives clouds."""

    input: ReceptionParams = ReceptionParams()
    base_frame: str = param(
        "",
        "A frame on the ground, such as base_footprint. If set, height, roll and pitch of the sensor come from TF "
        "instead of ground.sensor_pose, and all computations use the levelled cloud. Empty: off.",
        fixed=True,
    )
    autostart: bool = param(
        True,
        "Configure and activate the node at the start. false: leave this to a lifecycle manager, such as Nav2's, or "
        "to `ros2 lifecycle`.",
        fixed=True,
    )


@dataclass(frozen=True)
class BoxNodeParams(CloudNodeParams):
    """Parameters of every node that publishes boxes."""

    output: MarkerParams = MarkerParams()
    target_frame: str = param(
        "",
        "Frame of the published boxes; they are transformed with TF at the stamp of their cloud. Empty: the "
        "cloud's frame.",
        fixed=True,
    )


@dataclass(frozen=True)
class GroundExtraParams(CloudNodeParams):
    """Additional parameters of ground_segmentation."""

    range: str = param(
        "all",
        "Segment only the points that a detector with this range reads, see `fused.range`; "
        "the other points have 2 in `in_view`. Launch files and `demo` set it if all detectors have "
        "the same range. The outputs ground, nonground and obstacles always cover the full cloud.",
        choices=("all", "ahead", "around"),
    )
    obstacles: ObstacleParams = ObstacleParams()


@dataclass(frozen=True)
class DetectionNodeParams(BoxNodeParams):
    """Parameters of every node that detects objects in clouds."""

    output: TrackMarkerParams = TrackMarkerParams()
    tracking: OptionalTracking = OptionalTracking()
    ego: EgoParams = EgoParams()


@dataclass(frozen=True)
class PerceptionExtraParams(DetectionNodeParams):
    """Additional parameters of perception."""

    obstacles: ObstacleParams = ObstacleParams()


@dataclass(frozen=True)
class TrackerExtraParams(CloudNodeParams):
    """Additional parameters of the tracker node.

    Its input queue is longer than that of other nodes, so that no detections are skipped.
    """

    input: ReceptionParams = ReceptionParams(queue=10)
    output: TrackMarkerParams = TrackMarkerParams()


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
    """Parameters of bag_player, which replays a bag."""

    bag: str = param("", "Folder of the bag, or a single .mcap, .db3 or ROS 1 .bag file.", fixed=True)
    rate: float = param(1.0, "Speed of the replay; 2.0 is twice as fast as recorded.", low=0.01, high=100.0)
    loop: bool = param(False, "Start again at the end.")
    start_offset: float = param(
        0.0, "Skip this much of the bag. Latched topics are still replayed.", unit="s", low=0.0, fixed=True
    )
    duration: float = param(0.0, "Play this much of the bag; 0 plays all.", unit="s", low=0.0, fixed=True)
    start_paused: bool = param(False, "Wait for ~/resume or ~/step before the first message.", fixed=True)
    topics: tuple[str, ...] = param(str, "Topics to play; empty plays all.", fixed=True)
    remap: tuple[str, ...] = param(str, "Topics to rename, each as OLD:=NEW.", fixed=True)
    clock_hz: float = param(
        0.0, "Rate of /clock messages with the bag's time; 0: none.", unit="Hz", low=0.0, high=1000.0, fixed=True
    )
    wait_for: tuple[str, ...] = param(
        str,
        "Topics that must have a subscriber, or COUNT subscribers with TOPIC:=COUNT, before the first message is "
        "sent. They may be topics of other nodes. Empty: the bag's clouds.",
        fixed=True,
    )
    follow: tuple[str, ...] = param(
        str,
        "Topics of detections (MarkerArray): the next cloud is sent when the detections of the previous clouds have "
        "arrived on all of these topics, so that no cloud is lost; meanwhile the bag's time is paused. Empty: play "
        "in real time, like a sensor.",
        fixed=True,
    )
    ahead: int = param(
        1,
        "With `follow`: maximum number of clouds whose detections have not "
        "arrived yet. The nodes need an `input.queue` of at least this size. "
        "0: play in real time, and only measure when the detections arrive.",
        low=0,
        high=1000,
        fixed=True,
    )
    follow_timeout: float = param(
        10.0,
        "Maximum time to wait for the detections of a cloud; missing ones are counted.",
        unit="s",
        low=0.1,
        high=3600.0,
        fixed=True,
    )
    wait_timeout: float = param(
        10.0, "Start without subscribers after this time; 0: do not wait.", unit="s", low=0.0, high=3600.0, fixed=True
    )


@dataclass(frozen=True)
class RecorderParams(Params):
    """Parameters of bag_recorder, which records topics to a rosbag2 bag."""

    bag: str = param("", "Folder to create for the bag.", fixed=True)
    topics: tuple[str, ...] = param(str, "Topics to record.", fixed=True)
    compression: str = param(
        "zstd",
        "Compression of the bag: zstd (level 1), lz4, or none, which needs the least CPU time and the most disk space.",
        choices=("zstd", "lz4", "none"),
        fixed=True,
    )


@dataclass(frozen=True)
class EvaluatorParams(Params):
    """Parameters of the evaluator, which scores detections against ground truth."""

    stages: tuple[str, ...] = param(("final",), "Inputs to score; each NAME is the topic ~/input/NAME.", fixed=True)
    timing: tuple[str, ...] = param(
        str, "Topics with run times in ms (std_msgs/Float64); their medians are reported.", fixed=True
    )
    file: str = param(
        "", "JSON file for the scores, written at the end and every few seconds; empty: none.", fixed=True
    )
    classes: tuple[str, ...] = param(tuple(DETECTED), f"Classes to score, of {', '.join(DETECTED)}.", fixed=True)
    only_with_pedestrians: bool = param(
        True, "Score pedestrians only in frames with a labelled pedestrian, as in the protocol of the STM-CPA paper."
    )
