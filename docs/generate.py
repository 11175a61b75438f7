"""Makes docs/reference/nodes/*.md from the parameter dataclasses, config/best.param.yaml from
configurations.py, and those of the detectors with a network from their parameters:
python docs/generate.py

test/test_docs.py holds that the pages are up to date and the topics those of the running nodes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from lidar_perception import params
from lidar_perception.candidates.configurations import BEST_VALUES
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.detectors.fused.params import FusedDetectorParams
from lidar_perception.detectors.pointnet.params import PointNetDetectorParams
from lidar_perception.detectors.pointpillars.params import DetectorParams
from lidar_perception.nodes.graph import NETWORKS
from lidar_perception.nodes.node_parameters import find_node_parameters
from lidar_perception.param_fields import flatten

CONFIG = Path(__file__).parents[1] / "config"
BEST = CONFIG / "best.param.yaml"
FOLDER = Path(__file__).parent / "reference" / "nodes"
CLOUD, MARKERS = "sensor_msgs/PointCloud2", "visualization_msgs/MarkerArray"
STRING_TIMES = "std_msgs/Float64"

# Parameters that users need first, in this order; a node's page folds all others.
FIRST = (
    "bag", "topics", "rate", "loop", "wait_for", "follow", "file", "stages",
    "fused.scores.pedestrian", "fused.scores.car", "fused.scores.cyclist", "fused.range",
    "fused.weights", "fused.device", "pointpillars.version", "pointpillars.weights",
    "pointpillars.range", "pointpillars.scores.car", "pointpillars.scores.pedestrian",
    "pointpillars.device", "pointnet.weights", "pointnet.scores.car", "pointnet.scores.pedestrian",
    "pointnet.device", "seed.source", "seed.file", "stm.threshold", "clustering.method",
    "ground.method", "base_frame", "target_frame", "ground.sensor_pose.height",
    "input.intensity_max", "input.ahead", "input.deskew", "crop.body", "tracking.enabled",
    "ego.source", "tracking.report", "tracking.max_gap", "output.trail", "autostart",
)

CAMERA_IN = [
    ("~/input/camera_info", "sensor_msgs/CameraInfo", "P and the image size; latched. Only needed "
     "with `view.enabled`."),
    ("~/input/extrinsics", "geometry_msgs/TransformStamped", "The camera in the LiDAR frame or the "
     "other way round; latched. TF is asked too where tf2_msgs is installed."),
]
SEED_IN = [
    ("~/input/ground_truth", MARKERS, "Labels, for `seed.source` ground_truth; matched to the "
     "cloud by header.stamp."),
    ("clicked_point", "geometry_msgs/PointStamped", "A point on a pedestrian, for `seed.source` "
     "click, in the frame of the cloud or, with TF, in any that is connected with it."),
]
ROBOT_IN = [
    ("~/input/odometry", "nav_msgs/Odometry", "How the robot moves, for `input.deskew` "
     "odometry, and where there is a tracker for `ego.source` auto and odometry."),
    ("/tf, /tf_static", "tf2_msgs/TFMessage", "Where tf2_msgs is installed; /tf only with "
     "`base_frame`, `target_frame`, `input.deskew` or `ego.source` tf, a click, or a tracker "
     "without odometry."),
]
DETECTIONS_3D = ("~/output/detections_3d", "vision_msgs/Detection3DArray", "The same, where "
                 "vision_msgs is installed.")
TRACKS_OUT = [
    ("~/output/tracks", MARKERS, "Tracks: boxes whose ids stay, with score, velocity and "
     "probability of motion in the text; in the namespaces `velocity`, `number` and `trail` an "
     "arrow, a text and the way of each. In the frame of the detections."),
    ("~/output/tracks_3d", "vision_msgs/Detection3DArray", "The same with ids and covariances, "
     "where vision_msgs is installed."),
]
BOXES_OUT = [
    ("~/output/detections", MARKERS, "Boxes with class and score; an empty array still carries the "
     "stamp."),
    DETECTIONS_3D,
]
CANDIDATES_OUT = [
    ("~/output/detections", MARKERS, "The candidates (STM + CPA); an empty array still carries the "
     "stamp."),
    DETECTIONS_3D,
    ("~/debug/stage1", MARKERS, "Clusters of the seed's height; made only while subscribed."),
    ("~/debug/stage2", MARKERS, "After STM without CPA; made only while subscribed."),
    ("~/debug/height_ms, stm_ms, cpa_ms, confidence_ms", STRING_TIMES, "Time of each "
     "step; perception has view_ms, ground_ms, clustering_ms and boxes_ms too."),
]
ALWAYS_OUT = [
    ("~/debug/processing_time_ms", STRING_TIMES, "Time of the work on one cloud."),
    ("/diagnostics", "diagnostic_msgs/DiagnosticArray", "Once a second and at every change: state, "
     "reason, counts, rate, lost and dropped clouds, subscribers of the outputs."),
]
MANAGED_OUT = [("~/transition_event", "lifecycle_msgs/TransitionEvent", "Each change of the state, "
                "see [lifecycle](../../how-to/lifecycle.md).")]
MANAGED_SERVICES = [
    ("~/change_state", "lifecycle_msgs/ChangeState", "Configure, activate, deactivate, clean up, "
     "shut down."),
    ("~/get_state", "lifecycle_msgs/GetState", "And the others of a managed node."),
]
OBSTACLES_OUT = ("~/output/obstacles", CLOUD, "x y z, and intensity where the cloud has one, of "
                 "the points that are no ground and within the heights of `obstacles`, for a "
                 "costmap ([nav2](../../how-to/nav2.md)); made only while subscribed.")
COLUMNS = "columns `ground` (uint8, 1 = ground) and `in_view` (uint8, 1 = processed)"

PAGES: dict[str, dict[str, Any]] = {
    "ground_segmentation": dict(
        params=params.GroundNodeParams(),
        what="Marks the ground points of a cloud, by one plane, by Patchwork++ or by a cloth"
             " simulation (`ground.method`). Warns if the sensor is mounted at another "
             "height than `sensor_pose` says, and if the scale of the intensity does not "
             "fit.",
        inputs=[("~/input/points", CLOUD, "Any field layout, byte order and shape."), *CAMERA_IN],
        outputs=[("~/output/points", CLOUD, f"The same cloud with the {COLUMNS}."),
                 ("~/output/ground", CLOUD, "Ground points only; made only while subscribed."),
                 ("~/output/nonground", CLOUD, "The other points in view; likewise."),
                 OBSTACLES_OUT]),
    "clustering": dict(
        params=params.ClusteringNodeParams(),
        what="Clusters the points that are not ground: distance-aware DBSCAN, exact, or "
             "adaptive Euclidean clustering (`clustering.method`).",
        inputs=[("~/input/points", CLOUD, "With column `ground`; without it everything is "
                 "clustered and a diagnostic says so.")],
        outputs=[("~/output/points", CLOUD, "The same cloud with the column `cluster_id` (uint32, "
                  "0 = none)."),
                 ("~/output/boxes", MARKERS, "Cluster boxes, down to the ground; the text has "
                  "`size_class` by the diagonal. Made only while subscribed.")]),
    "candidate_refinement": dict(
        params=params.RefinementNodeParams(),
        what="Finds pedestrian candidates among clusters: ground snapping, height filter, "
             "single template matching, centralized point augmentation.",
        inputs=[("~/input/points", CLOUD, "With columns `ground` and `cluster_id`."), *SEED_IN],
        outputs=CANDIDATES_OUT),
    "perception": dict(
        params=PipelineParams(),
        what="The three stages in one process, with the same parameters and results and "
             "without the copies between them.",
        inputs=[("~/input/points", CLOUD, "Any field layout, byte order and shape."), *CAMERA_IN,
                *SEED_IN],
        outputs=[("~/output/points", CLOUD, f"The same cloud with the {COLUMNS} and `cluster_id`; "
                  "made only while subscribed."),
                 ("~/output/boxes", MARKERS, "Cluster boxes; made only while subscribed."),
                 OBSTACLES_OUT,
                 *CANDIDATES_OUT]),
    "pointpillars_detector": dict(
        params=DetectorParams(),
        what="Detects cars, pedestrians and cyclists with PointPillars and the four versions"
             " of EG-PointPillars ([how](../../explanation/pointpillars.md)). Loads and "
             "warms up before it subscribes. Without weights it says so in a diagnostic and "
             "publishes nothing. Warns if nothing can be found (the cloud is out of range, "
             "has no intensity, all of it is ground ...), if CUDA is asked for and missing "
             "or out of memory, and if height or intensity do not fit; where every score is "
             "below its threshold the diagnostic has the best ones. Files: "
             "`launch/pointpillars.launch.py`, `config/pointpillars.param.yaml`.",
        inputs=[("~/input/points", CLOUD, "Any field layout, byte order and shape. The columns "
                 "`ground` and `cluster_id` are used where they are there; what else the version "
                 "needs is computed.")],
        outputs=[*BOXES_OUT,
                 ("~/debug/preprocess_ms, experts_ms, network_ms, postprocess_ms", STRING_TIMES,
                  "Time of each step.")]),
    "pointnet_detector": dict(
        params=PointNetDetectorParams(),
        what="Detects cars, pedestrians and cyclists among the clusters of the whole cloud: "
             "each is classified and gets a box ([how](../../explanation/pointnet.md)). "
             "Loads and warms up before it subscribes. Without weights it says so in a "
             "diagnostic and publishes nothing. Warns if nothing can be found (no clusters, "
             "all of them too small, no intensity ...), if CUDA is asked for and missing or "
             "out of memory, and if height or intensity do not fit; where every score is "
             "below its threshold the diagnostic has the best ones. Files: "
             "`launch/pointnet.launch.py`, `config/pointnet.param.yaml`.",
        inputs=[("~/input/points", CLOUD, "Any field layout, byte order and shape. The column "
                 "`cluster_id` is used where it is there, or else the column `ground`; what is "
                 "missing is computed.")],
        outputs=[*BOXES_OUT,
                 ("~/debug/preprocess_ms, ground_ms, clustering_ms, network_ms, postprocess_ms",
                  STRING_TIMES, "Time of each step.")]),
    "fused_detector": dict(
        params=FusedDetectorParams(),
        what="Detects cars, pedestrians and cyclists: PointPillars proposes boxes, "
             "silhouettes and PointNet judge them, and the score is the probability that the"
             " object is there ([how](../../explanation/fused.md)). Loads and warms up "
             "before it subscribes. Without weights it reports that in /diagnostics and "
             "publishes nothing. It warns as pointpillars_detector does. Files: "
             "`launch/fused.launch.py`, `config/fused.param.yaml`.",
        inputs=[("~/input/points", CLOUD, "Any field layout, byte order and shape. The columns "
                 "`ground`, and for PointPillars `cluster_id`, are used where they are there; what "
                 "is missing is computed, and so are the clusters of people.")],
        outputs=[*BOXES_OUT,
                 ("~/debug/preprocess_ms, ground_ms, proposals_ms, evidence_ms, "
                  "fusion_ms", STRING_TIMES, "Time of each step.")]),
    "tracker": dict(
        params=params.TrackerNodeParams(),
        what="Turns the detections of any detector into tracks with ids and velocities; "
             "scores are the evidence over time ([how](../../explanation/tracking.md)). A "
             "lost frame is predicted over with the next one and gets no message of its own;"
             " a late frame, and one with the stamp of the last one, get none either. A jump"
             " in time, as of a bag that starts again, ends all tracks. /diagnostics names "
             "what is wrong with a frame or the poses. The detector nodes do the same in "
             "their own process with `tracking.enabled`, then from weak detections too. "
             "Files: the argument `tracking:=true` of the launch files, "
             "`config/tracker.param.yaml`.",
        inputs=[("~/input/detections", MARKERS, "CUBEs with `ns` as class, and a score in the text "
                 "as JSON. A frame without any is a DELETE or DELETEALL with its header."),
                ("~/input/detections_3d", "vision_msgs/Detection3DArray", "Or this, where "
                 "vision_msgs is installed; one of both."),
                ("~/input/odometry", "nav_msgs/Odometry", "How the robot moves, for `ego.source` "
                 "auto and odometry. For kiss_icp, and auto where no poses come, ~/input/points "
                 "(PointCloud2) has the scans.")],
        outputs=TRACKS_OUT),
    "evaluator": dict(
        params=params.EvaluatorParams(),
        what="Scores detections against ground truth by the protocol of the STM-CPA paper.",
        inputs=[("~/input/ground_truth", MARKERS, "Labels; matched by header.stamp."),
                ("~/input/STAGE", MARKERS, "One topic for each name in `stages`.")],
        outputs=[]),
    "bag_player": dict(
        params=params.PlayerParams(),
        what="Replays a rosbag2 bag (MCAP or SQLite3), or one of ROS 1. Messages go from the"
             " file to DDS as they are. Ends with exit code 0 when the bag is played.",
        inputs=[],
        outputs=[("the topics of the bag", "as recorded", "With the recorded QoS. Livox "
                  "CustomMsg and CompressedPointCloud2 as PointCloud2."),
                 ("/clock", "rosgraph_msgs/Clock", "The bag's time, with `clock_hz`.")],
        services=[("~/pause, ~/resume", "std_srvs/Trigger", ""),
                  ("~/step", "std_srvs/Trigger", "While paused: one more cloud and what comes "
                   "before it."),
                  ("~/set_rate", "rosbag2_interfaces/SetRate", "Where rosbag2_interfaces is "
                   "installed; the parameter `rate` does the same everywhere.")]),
    "bag_recorder": dict(
        params=params.RecorderParams(),
        what="Records topics to an MCAP bag. The bag appears under its name when the node "
             "ends.",
        inputs=[("the topics named in topics", "any", "With the QoS of their publishers.")],
        outputs=[]),
}


def outputs(name: str) -> list[tuple[str, str, str]]:
    """Rows of all that a node publishes."""
    return PAGES[name]["outputs"] + ALWAYS_OUT + (MANAGED_OUT if _managed(name) else [])


def _managed(name: str) -> bool:
    return "autostart" in find_node_parameters(name)


def page(name: str) -> str:
    node = PAGES[name]
    lines = [f"# {name}", "", node["what"], "",
             f"    ros2 run lidar_perception {name}      # or: lidar-perception run {name}", ""]
    own = {topic for topic, *_ in node["inputs"]}
    robot = [row for row in ROBOT_IN if "base_frame" in find_node_parameters(name)
             and row[0] not in own]
    for title, rows in (("Subscribes", node["inputs"] + robot), ("Publishes", outputs(name)),
                        ("Services", MANAGED_SERVICES if _managed(name)
                         else node.get("services", []))):
        if rows:
            lines += [f"## {title}", "", "| name | type | |", "|---|---|---|",
                      *(f"| `{a}` | {b} | {c} |" for a, b, c in rows), ""]
    if "tracking.enabled" in find_node_parameters(name):
        lines += ["With `tracking.enabled` the node has the topics of the [tracker](tracker.md), "
                  "too; a detector with a network then tracks weak detections as well, from "
                  "`tracking.min_score` on.", ""]
    known = find_node_parameters(name)
    first = [key for key in FIRST if key in known][:10] or [*known][:10]
    rest = [key for key in known if key not in first]
    lines += ["## Parameters", "", *_parameter_table(known, first)]
    if rest:
        summary = f"<summary>{len(rest)} more parameters</summary>"
        lines += ["", '<details markdown="1">', summary, "", *_parameter_table(known, rest), "",
                  "</details>"]
    return "\n".join(lines) + "\n"


def _parameter_table(known: dict[str, Any], names: list[str]) -> list[str]:
    rows = ["| name | default | range | |", "|---|---|---|---|"]
    for key in names:
        f = known[key]
        rows.append(f"| `{key}` | {_default(f)} | {_range(f)} | {f.metadata['doc']}"
                    + (" Fixed at start." if f.metadata["fixed"] else "") + " |")
    return rows


def best() -> str:
    """The parameter file of the configuration `best`, for nodes."""
    return _parameter_file("The configuration `best` (lidar_perception/candidates/"
                           "configurations.py), for nodes", BEST_VALUES)


def config_file(network: str) -> Path:
    """The parameter file of a detector's graph."""
    return CONFIG / f"{network}.param.yaml"


def config(network: str) -> str:
    """What is in it: the detector's numbers for the nodes that find ground and clusters."""
    shared = (params.GroundNodeParams(), params.ClusteringNodeParams())
    defaults = {key: value for group in shared for key, value in flatten(group).items()}
    values = {key: value for key, value in flatten(PAGES[f"{network}_detector"]["params"]).items()
              if key in defaults and value != defaults[key]}
    return _parameter_file(f"The ground and clusters of detectors/{network}/params.py, for the "
                           "nodes that find ground and clusters", values)


def _parameter_file(what: str, values: dict[str, Any]) -> str:
    tree: dict[str, Any] = {}
    for key, value in values.items():
        *groups, name = key.split(".")
        place = tree
        for group in groups:
            place = place.setdefault(group, {})
        place[name] = list(value) if isinstance(value, tuple) else value
    return (f"# {what}; made by docs/generate.py.\n"
            "# Every parameter with its unit, range and default: docs/reference/nodes/.\n"
            + yaml.safe_dump({"/**": {"ros__parameters": tree}}, sort_keys=False))


def _default(f: Any) -> str:
    unit = f" {f.metadata['unit']}" if f.metadata["unit"] else ""
    if isinstance(f.default, tuple):
        return ", ".join(map(str, f.default)) + unit if f.default else "empty"
    return (str(f.default).lower() if isinstance(f.default, bool) else str(f.default) or "empty"
            ) + unit


def _range(f: Any) -> str:
    low, high, choices = (f.metadata[k] for k in ("low", "high", "choices"))
    if choices:
        return ", ".join(choices)
    if low is None and high is None:
        return ""
    return f"{'' if low is None else f'{low:g}'} .. {'' if high is None else f'{high:g}'}"


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name in PAGES:
        (FOLDER / f"{name}.md").write_text(page(name))
    BEST.write_text(best())
    for network in NETWORKS:
        config_file(network).write_text(config(network))
