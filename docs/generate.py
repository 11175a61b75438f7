"""Generate pages and parameter files from the code: python docs/generate.py

These are docs/reference/nodes/*.md and config/*.param.yaml, from parameters, and the tables of
docs/explanation/papers.md. test/test_docs.py checks that they are up to date and list the topics of
the running nodes.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

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

sys.path.insert(0, str(Path(__file__).parents[1]))  # experiments/ is not installed
from experiments.departures import DEPARTURES, MEASURED

CONFIG = Path(__file__).parents[1] / "config"
PAPERS = Path(__file__).parent / "explanation" / "papers.md"
BEST = CONFIG / "best.param.yaml"
FOLDER = Path(__file__).parent / "reference" / "nodes"
CLOUD, MARKERS = "sensor_msgs/PointCloud2", "visualization_msgs/MarkerArray"
STRING_TIMES = "std_msgs/Float64"

# Most important parameters, in this order; the pages of nodes fold all others.
FIRST = (
    "bag",
    "topics",
    "rate",
    "loop",
    "wait_for",
    "follow",
    "file",
    "stages",
    "fused.scores.pedestrian",
    "fused.scores.car",
    "fused.scores.cyclist",
    "fused.range",
    "fused.weights",
    "fused.device",
    "pointpillars.version",
    "pointpillars.weights",
    "pointpillars.range",
    "pointpillars.scores.car",
    "pointpillars.scores.pedestrian",
    "pointpillars.device",
    "pointnet.weights",
    "pointnet.scores.car",
    "pointnet.scores.pedestrian",
    "pointnet.device",
    "seed.source",
    "seed.file",
    "stm.threshold",
    "clustering.method",
    "ground.method",
    "base_frame",
    "target_frame",
    "ground.sensor_pose.height",
    "input.intensity_max",
    "input.ahead",
    "input.deskew",
    "crop.body",
    "tracking.enabled",
    "ego.source",
    "tracking.report",
    "tracking.max_gap",
    "output.trail",
    "autostart",
)

CAMERA_IN = [
    (
        "~/input/camera_info",
        "sensor_msgs/CameraInfo",
        "P and the image size; latched. Only needed with `view.enabled`.",
    ),
    (
        "~/input/extrinsics",
        "geometry_msgs/TransformStamped",
        "Pose of the camera in the LiDAR frame or vice versa; latched. TF is used too if tf2_msgs is installed.",
    ),
]
SEED_IN = [
    ("~/input/ground_truth", MARKERS, "Labels, for `seed.source` ground_truth; matched to the cloud by header.stamp."),
    (
        "clicked_point",
        "geometry_msgs/PointStamped",
        "A point on a pedestrian, for `seed.source` "
        "click, in the frame of the cloud or, with TF, in any connected frame.",
    ),
]
ROBOT_IN = [
    (
        "~/input/odometry",
        "nav_msgs/Odometry",
        "Motion of the robot, for `input.deskew` odometry, and with a tracker for `ego.source` auto and odometry.",
    ),
    (
        "/tf, /tf_static",
        "tf2_msgs/TFMessage",
        "If tf2_msgs is installed; /tf only with "
        "`base_frame`, `target_frame`, `input.deskew` or `ego.source` tf, a click, or a tracker "
        "without odometry.",
    ),
]
DETECTIONS_3D = ("~/output/detections_3d", "vision_msgs/Detection3DArray", "The same, if vision_msgs is installed.")
TRACKS_OUT = [
    (
        "~/output/tracks",
        MARKERS,
        "Tracks: boxes with persistent ids, and score, velocity and "
        "probability of motion in the text. The namespaces `velocity`, `number` and `trail` have an "
        "arrow, a number and the path of each track. In the frame of the detections.",
    ),
    (
        "~/output/tracks_3d",
        "vision_msgs/Detection3DArray",
        "The same with ids and covariances, if vision_msgs is installed.",
    ),
]
BOXES_OUT = [
    ("~/output/detections", MARKERS, "Boxes with class and score; an empty array still carries the stamp."),
    DETECTIONS_3D,
]
CANDIDATES_OUT = [
    ("~/output/detections", MARKERS, "The candidates (STM + CPA); an empty array still carries the stamp."),
    DETECTIONS_3D,
    ("~/debug/stage1", MARKERS, "Clusters of the seed's height; published only while subscribed."),
    ("~/debug/stage2", MARKERS, "After STM without CPA; published only while subscribed."),
    (
        "~/debug/height_ms, stm_ms, cpa_ms, confidence_ms",
        STRING_TIMES,
        "Time of each step; perception has view_ms, ground_ms, clustering_ms and boxes_ms too.",
    ),
]
ALWAYS_OUT = [
    ("~/debug/processing_time_ms", STRING_TIMES, "Processing time of one cloud."),
    (
        "/diagnostics",
        "diagnostic_msgs/DiagnosticArray",
        "Once a second and on every change: state, "
        "reason, counts, rate, lost and dropped clouds, subscribers of the outputs.",
    ),
]
MANAGED_OUT = [
    (
        "~/transition_event",
        "lifecycle_msgs/TransitionEvent",
        "State changes, see [lifecycle](../../how-to/lifecycle.md).",
    )
]
MANAGED_SERVICES = [
    ("~/change_state", "lifecycle_msgs/ChangeState", "Configure, activate, deactivate, clean up, shut down."),
    ("~/get_state", "lifecycle_msgs/GetState", "And the other services of a managed node."),
]
OBSTACLES_OUT = (
    "~/output/obstacles",
    CLOUD,
    "x y z, and intensity if the cloud has one, of the "
    "points that are not ground and within the heights of `obstacles`, for a "
    "costmap ([nav2](../../how-to/nav2.md)); published only while subscribed.",
)
COLUMNS = "columns `ground` (uint8, 1 = ground) and `in_view` (uint8, 1 = processed)"

PAGES: dict[str, dict[str, Any]] = {
    "ground_segmentation": dict(
        params=params.GroundNodeParams(),
        what="Marks the ground points of a cloud with one plane, Patchwork++ or a cloth "
        "simulation (`ground.method`). Warns if the height of the sensor differs from "
        "`sensor_pose`, or if the scale of the intensity does not fit.",
        inputs=[("~/input/points", CLOUD, "Any field layout, byte order and shape."), *CAMERA_IN],
        outputs=[
            ("~/output/points", CLOUD, f"The same cloud with the {COLUMNS}; `in_view` is 2 outside `range`."),
            ("~/output/ground", CLOUD, "Ground points; published only while subscribed."),
            ("~/output/nonground", CLOUD, "The other points in view; published only while subscribed."),
            OBSTACLES_OUT,
        ],
    ),
    "clustering": dict(
        params=params.ClusteringNodeParams(),
        what="Clusters the points that are not ground: distance-aware DBSCAN, exact, or "
        "adaptive Euclidean clustering (`clustering.method`).",
        inputs=[
            (
                "~/input/points",
                CLOUD,
                "With column `ground`; without it all points are clustered and /diagnostics reports it.",
            )
        ],
        outputs=[
            ("~/output/points", CLOUD, "The same cloud with the column `cluster_id` (uint32, 0 = none)."),
            (
                "~/output/boxes",
                MARKERS,
                "Cluster boxes, down to the ground; the text has "
                "`size_class` by the diagonal. Published only while subscribed.",
            ),
        ],
    ),
    "candidate_refinement": dict(
        params=params.RefinementNodeParams(),
        what="Finds pedestrian candidates among clusters: ground snapping, height filter, "
        "single template matching, centralized point augmentation.",
        inputs=[("~/input/points", CLOUD, "With columns `ground` and `cluster_id`."), *SEED_IN],
        outputs=CANDIDATES_OUT,
    ),
    "perception": dict(
        params=PipelineParams(),
        what="The three stages in one process, with the same parameters and results and "
        "without the copies between them.",
        inputs=[("~/input/points", CLOUD, "Any field layout, byte order and shape."), *CAMERA_IN, *SEED_IN],
        outputs=[
            (
                "~/output/points",
                CLOUD,
                f"The same cloud with the {COLUMNS} and `cluster_id`; published only while subscribed.",
            ),
            ("~/output/boxes", MARKERS, "Cluster boxes; published only while subscribed."),
            OBSTACLES_OUT,
            *CANDIDATES_OUT,
        ],
    ),
    "pointpillars_detector": dict(
        params=DetectorParams(),
        what="Detects cars, pedestrians and cyclists with PointPillars and the four versions"
        " of EG-PointPillars ([how](../../explanation/pointpillars.md)). Loads and "
        "warms up before it subscribes. Without weights it publishes nothing and reports "
        "the reason on /diagnostics. Warns if nothing can be found (the cloud is out of "
        "range, has no intensity, is all ground ...), if CUDA is selected but missing or "
        "out of memory, and if height or intensity do not fit. If all scores are below "
        "their thresholds, /diagnostics has the best ones. Files: "
        "`launch/pointpillars.launch.py`, `config/pointpillars.param.yaml`.",
        inputs=[
            (
                "~/input/points",
                CLOUD,
                "Any field layout, byte order and shape. The columns "
                "`ground` and `cluster_id` are used if present, otherwise computed if the version "
                "needs them.",
            )
        ],
        outputs=[
            *BOXES_OUT,
            ("~/debug/preprocess_ms, experts_ms, network_ms, postprocess_ms", STRING_TIMES, "Time of each step."),
        ],
    ),
    "pointnet_detector": dict(
        params=PointNetDetectorParams(),
        what="Detects cars, pedestrians and cyclists among the clusters of the whole cloud: "
        "each is classified and gets a box ([how](../../explanation/pointnet.md)). "
        "Loads and warms up before it subscribes. Without weights it publishes nothing "
        "and reports the reason on /diagnostics. Warns if nothing can be found (no "
        "clusters, only small clusters, no intensity ...), if CUDA is selected but missing "
        "or out of memory, and if height or intensity do not fit. If all scores are below "
        "their thresholds, /diagnostics has the best ones. Files: "
        "`launch/pointnet.launch.py`, `config/pointnet.param.yaml`.",
        inputs=[
            (
                "~/input/points",
                CLOUD,
                "Any field layout, byte order and shape. The columns "
                "`cluster_id` and `ground` are used if present, otherwise computed.",
            )
        ],
        outputs=[
            *BOXES_OUT,
            (
                "~/debug/preprocess_ms, ground_ms, clustering_ms, network_ms, postprocess_ms",
                STRING_TIMES,
                "Time of each step.",
            ),
        ],
    ),
    "fused_detector": dict(
        params=FusedDetectorParams(),
        what="Detects cars, pedestrians and cyclists: PointPillars proposes boxes, "
        "silhouettes and PointNet classify them, and the score is the probability that the"
        " object exists ([how](../../explanation/fused.md)). Loads and warms up before it "
        "subscribes. Without weights it publishes nothing and reports the reason on "
        "/diagnostics. It has the same warnings as pointpillars_detector. Files: "
        "`launch/fused.launch.py`, `config/fused.param.yaml`.",
        inputs=[
            (
                "~/input/points",
                CLOUD,
                "Any field layout, byte order and shape. The columns "
                "`ground`, and for PointPillars `cluster_id`, are used if present, otherwise "
                "computed. The clusters of people are always computed.",
            )
        ],
        outputs=[
            *BOXES_OUT,
            (
                "~/debug/preprocess_ms, ground_ms, proposals_ms, evidence_ms, fusion_ms",
                STRING_TIMES,
                "Time of each step.",
            ),
        ],
    ),
    "tracker": dict(
        params=params.TrackerNodeParams(),
        what="Turns the detections of any detector into tracks with ids and velocities; "
        "scores accumulate evidence over time ([how](../../explanation/tracking.md)). "
        "Every frame of detections results in one message, except late and repeated "
        "frames. Tracks are predicted across lost frames. A jump in time, such as the "
        "restart of a bag, ends all tracks. /diagnostics reports problems with a frame or "
        "the poses. The detector nodes do the same in their own process with "
        "`tracking.enabled`, and then also use weak detections. Files: the argument "
        "`tracking:=true` of the launch files, `config/tracker.param.yaml`.",
        inputs=[
            (
                "~/input/detections",
                MARKERS,
                "CUBEs with `ns` as class, and a score in the text "
                "as JSON. A frame without detections is a DELETE or DELETEALL with its header.",
            ),
            (
                "~/input/detections_3d",
                "vision_msgs/Detection3DArray",
                "Alternative to ~/input/detections, if vision_msgs is installed.",
            ),
            (
                "~/input/odometry",
                "nav_msgs/Odometry",
                "Motion of the robot, for `ego.source` "
                "auto and odometry. For kiss_icp, and for auto without poses, ~/input/points "
                "(PointCloud2) has the scans.",
            ),
        ],
        outputs=TRACKS_OUT,
    ),
    "evaluator": dict(
        params=params.EvaluatorParams(),
        what="Scores detections against ground truth: by centre distance within 1 m while it runs, "
        "as in the STM-CPA paper, and by KITTI's average precision at its end. In `file` the "
        "scores of Pedestrian are at the top level, those of the other classes in `classes`, "
        "and the average precision, of at most 10,000 frames, in `ap`.",
        inputs=[
            ("~/input/ground_truth", MARKERS, "Labels; matched by header.stamp."),
            ("~/input/STAGE", MARKERS, "One topic for each name in `stages`."),
            (
                "~/input/camera_info",
                "sensor_msgs/CameraInfo",
                "Optional, with the extrinsics: objects outside the image are ignored, as KITTI has no labels there.",
            ),
            ("~/input/extrinsics", "geometry_msgs/TransformStamped", "Pose of the camera."),
        ],
        outputs=[],
    ),
    "bag_player": dict(
        params=params.PlayerParams(),
        what="Replays a rosbag2 bag (MCAP or SQLite3) or a ROS 1 bag. Messages are sent over DDS "
        "unchanged. Exits with code 0 at the end of the bag.",
        inputs=[],
        outputs=[
            (
                "the topics of the bag",
                "as recorded",
                "With the recorded QoS. Livox CustomMsg and CompressedPointCloud2 as PointCloud2.",
            ),
            ("/clock", "rosgraph_msgs/Clock", "The bag's time, with `clock_hz`."),
        ],
        services=[
            ("~/pause, ~/resume", "std_srvs/Trigger", ""),
            ("~/step", "std_srvs/Trigger", "While paused: play up to the next cloud."),
            (
                "~/set_rate",
                "rosbag2_interfaces/SetRate",
                "If rosbag2_interfaces is installed; the parameter `rate` always works.",
            ),
        ],
    ),
    "bag_recorder": dict(
        params=params.RecorderParams(),
        what="Records topics to an MCAP bag. The bag gets its final name when the node exits.",
        inputs=[("the topics named in topics", "any", "With the QoS of their publishers.")],
        outputs=[],
    ),
}


def outputs(name: str) -> list[tuple[str, str, str]]:
    """Return the rows of all topics that a node publishes."""
    return PAGES[name]["outputs"] + ALWAYS_OUT + (MANAGED_OUT if _managed(name) else [])


def _managed(name: str) -> bool:
    return "autostart" in find_node_parameters(name)


def page(name: str) -> str:
    node = PAGES[name]
    lines = [
        f"# {name}",
        "",
        node["what"],
        "",
        f"    ros2 run lidar_perception {name}      # or: lidar-perception run {name}",
        "",
    ]
    own = {topic for topic, *_ in node["inputs"]}
    robot = [row for row in ROBOT_IN if "base_frame" in find_node_parameters(name) and row[0] not in own]
    for title, rows in (
        ("Subscribes", node["inputs"] + robot),
        ("Publishes", outputs(name)),
        ("Services", MANAGED_SERVICES if _managed(name) else node.get("services", [])),
    ):
        if rows:
            lines += [
                f"## {title}",
                "",
                "| name | type | |",
                "|---|---|---|",
                *(f"| `{a}` | {b} | {c} |" for a, b, c in rows),
                "",
            ]
    if "tracking.enabled" in find_node_parameters(name):
        lines += [
            "With `tracking.enabled` the node has the topics of the [tracker](tracker.md), "
            "too; a detector with a network then also tracks weak detections, with scores "
            "of at least `tracking.min_score`.",
            "",
        ]
    known = find_node_parameters(name)
    first = [key for key in FIRST if key in known][:10] or [*known][:10]
    rest = [key for key in known if key not in first]
    lines += ["## Parameters", "", *_parameter_table(known, first)]
    if rest:
        summary = f"<summary>{len(rest)} more parameters</summary>"
        lines += ["", '<details markdown="1">', summary, "", *_parameter_table(known, rest), "", "</details>"]
    return "\n".join(lines) + "\n"


def _parameter_table(known: dict[str, Any], names: list[str]) -> list[str]:
    rows = ["| name | default | range | |", "|---|---|---|---|"]
    for key in names:
        f = known[key]
        rows.append(
            f"| `{key}` | {_default(f)} | {_range(f)} | {f.metadata['doc']}"
            + (" Fixed at start." if f.metadata["fixed"] else "")
            + " |"
        )
    return rows


def papers() -> str:
    """Return the page of the papers with new tables between its marks."""
    measured = [row._replace(command=f"`{row.command}`") for row in MEASURED]
    text = _replace_table(
        PAPERS.read_text(),
        "departures",
        ("paper, place", "the paper", "here", "option for the paper's reading"),
        DEPARTURES,
    )
    return _replace_table(text, "measured", ("paper, place", "what", "command", "data"), measured)


def _replace_table(text: str, mark: str, header: tuple[str, ...], rows: Sequence[NamedTuple]) -> str:
    """Return the text of a page with a table between the two lines with a mark."""
    begin, end = f"<!-- {mark}: made by docs/generate.py -->\n", f"<!-- end of {mark} -->\n"
    before, found, rest = text.partition(begin)
    _, found_end, after = rest.partition(end)
    if not (found and found_end):
        raise ValueError(f"the page needs the lines {begin!r} and {end!r}")
    table = "\n".join(_table(header, rows))
    return f"{before}{begin}\n{table}\n\n{end}{after}"


def _table(header: tuple[str, ...], rows: Sequence[NamedTuple]) -> list[str]:
    return [
        "| " + " | ".join(header) + " |",
        "|---" * len(header) + "|",
        *("| " + " | ".join(row) + " |" for row in rows),
    ]


def best() -> str:
    """Return the parameter file of the configuration `best`, for nodes."""
    return _parameter_file(
        "The configuration `best` (lidar_perception/candidates/configurations.py), for nodes", BEST_VALUES
    )


def config_file(network: str) -> Path:
    """Return the path of the parameter file of a detector's graph."""
    return CONFIG / f"{network}.param.yaml"


def config(network: str) -> str:
    """What is in it: the detector's numbers for the nodes that find ground and clusters."""
    shared = (params.GroundNodeParams(), params.ClusteringNodeParams())
    defaults = {key: value for group in shared for key, value in flatten(group).items()}
    values = {
        key: value
        for key, value in flatten(PAGES[f"{network}_detector"]["params"]).items()
        if key in defaults and value != defaults[key]
    }
    return _parameter_file(
        f"The ground and clusters of detectors/{network}/params.py, for the nodes that find ground and clusters", values
    )


def _parameter_file(what: str, values: dict[str, Any]) -> str:
    tree: dict[str, Any] = {}
    for key, value in values.items():
        *groups, name = key.split(".")
        place = tree
        for group in groups:
            place = place.setdefault(group, {})
        place[name] = list(value) if isinstance(value, tuple) else value
    return (
        f"# {what}; made by docs/generate.py.\n"
        "# Every parameter with its unit, range and default: docs/reference/nodes/.\n"
        + yaml.safe_dump({"/**": {"ros__parameters": tree}}, sort_keys=False)
    )


def _default(f: Any) -> str:
    unit = f" {f.metadata['unit']}" if f.metadata["unit"] else ""
    if isinstance(f.default, tuple):
        return ", ".join(map(str, f.default)) + unit if f.default else "empty"
    return (str(f.default).lower() if isinstance(f.default, bool) else str(f.default) or "empty") + unit


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
    PAPERS.write_text(papers())
    BEST.write_text(best())
    for network in NETWORKS:
        config_file(network).write_text(config(network))
