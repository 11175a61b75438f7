"""Arguments and nodes of the launch files. The nodes run in one process, or each in its own.

The parameters of a node come from the package's own file, then from the user's files, then from the
other launch arguments; later values override earlier ones.
"""

from __future__ import annotations

import sys
from collections.abc import Collection
from pathlib import Path
from typing import Any

import yaml
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, LogInfo, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription
from lidar_perception.nodes import NODES
from lidar_perception.nodes.graph import (
    CANDIDATES_GRAPH,
    DETECTOR_NODES,
    EXPERTS,
    NETWORKS,
    ODOMETRY_INPUT,
    SEPARATOR,
    SINGLE_PROCESS_CANDIDATES,
    SINGLE_PROCESS_NODES,
    TRACKER,
    add_node_prefix,
    build_graph,
    find_executable,
    find_expert_params,
    find_trackers,
    make_relative,
    runs_in_one_process,
)
from lidar_perception.nodes.launch_parameters import (
    CONFIGS,
    add_arguments,
    list_argument_parameters,
    list_parameter_files,
    split_detectors,
    write_section,
)
from lidar_perception.nodes.node_parameters import find_node_parameters
from lidar_perception.nodes.param_files import EVERY_NODE, describe_unknown_nodes, is_for, read_sections
from lidar_perception.types import InputError, make_unknown_name_error
from lidar_perception.wire.topics import ODOMETRY, POINTS

LAUNCH_ARGUMENTS = ("launch-prefix", "launch-prefix-filter")  # arguments that launch itself defines
RESPAWN_DELAY_S = 2.0  # keeps a node that cannot start from filling the log

SWITCH: dict[str, Any] = dict(default_value="false", choices=["true", "false"])
ARGUMENTS: dict[str, dict[str, Any]] = {
    "namespace": dict(
        default_value="",
        description="Namespace of all nodes and topics, for use with several sensors; /diagnostics, /tf and /clock "
        "stay global.",
    ),
    "name_prefix": dict(default_value="", description="Prefix of all node names."),
    "points": dict(default_value=make_relative(POINTS), description="Topic of the clouds."),
    "reliability": dict(
        default_value="",
        description="Parameter input.reliability: auto, reliable or best_effort; empty: as in the parameter file.",
    ),
    "base_frame": dict(
        default_value="",
        description="Parameter base_frame: frame on the ground below the robot, from which TF gives the pose of the "
        "sensor; empty: as in the parameter file.",
    ),
    "target_frame": dict(
        default_value="",
        description="Parameter target_frame: frame of the published boxes; empty: as in the parameter file.",
    ),
    "deskew": dict(
        default_value="",
        choices=["", "off", "odometry", "tf"],
        description="Parameter input.deskew: motion compensation of the clouds; empty: as in the parameter file.",
    ),
    "ahead": dict(
        default_value="",
        description="Parameter input.ahead: viewing direction of the "
        "detectors, in degrees from the x axis of the clouds; empty: as in the parameter "
        "file.",
    ),
    "range": dict(
        default_value="",
        choices=["", "auto", "ahead", "around"],
        description="Parameter range of fused and pointpillars: detection range; empty: as in the parameter file.",
    ),
    "config": dict(
        default_value="",
        description="Comma-separated parameter files for all nodes, loaded after config/*.param.yaml of each detector.",
    ),
    "weights": dict(
        default_value="",
        description="Checkpoint of the network; NAME=FILE,NAME=FILE "
        "for several networks; empty: as in the parameter file, or the packaged one.",
    ),
    "device": dict(
        default_value="",
        description="Device of the networks: auto, cpu, cuda or cuda:N; empty: as in the parameter file.",
    ),
    "tracking": dict(
        **SWITCH,
        description="Track the detections of each detector in a tracker node, or with `single` in the detector itself.",
    ),
    "odometry": dict(
        default_value=make_relative(ODOMETRY), description="Topic of the odometry for the trackers and deskew."
    ),
    "single": dict(**SWITCH, description="Run each detector in one process that also computes ground and clusters."),
    "processes": dict(
        default_value="auto",
        choices=["auto", "true", "false"],
        description="true: "
        "one process per node; false: one process for all nodes, which saves "
        "memory; auto: false on machines with up to four cores, otherwise true.",
    ),
    "autostart": dict(
        default_value="true",
        choices=["true", "false"],
        description="true: the nodes activate themselves; false: a lifecycle manager configures and activates them.",
    ),
    "respawn": dict(
        **SWITCH,
        description="Restart a node that has ended, for example after a "
        "crash; with autostart:=false the lifecycle manager must configure it again.",
    ),
    "rviz": dict(**SWITCH, description="Start RViz with config/lidar_perception.rviz in the same namespace."),
    "rviz_frame": dict(default_value="", description="Fixed frame of RViz; empty: velodyne, as in the RViz file."),
    "use_sim_time": dict(
        default_value="",
        choices=["", "true", "false"],
        description="Take the time from /clock; empty: as in the parameter file, otherwise false.",
    ),
    "log_level": dict(default_value="info", description="Minimum level of log messages: debug, info, warn, error."),
}


def make_launch_description(config_folder: Path, detectors: str) -> LaunchDescription:
    """Return the launch description of ground segmentation, clustering and detectors.

    Its launch arguments are `detectors` and ARGUMENTS.

    Args:
        config_folder: folder with the parameter files of the package.
        detectors: default of the launch argument `detectors`, comma-separated.
    """
    argument_names = find_argument_names()

    def make_actions(context: Any) -> list[Any]:
        reject_unknown_arguments(argument_names, context, ["detectors", *ARGUMENTS])
        value = {k: context.perform_substitution(LaunchConfiguration(k)) for k in ("detectors", *ARGUMENTS)}
        processes = create_nodes(value, config_folder)
        graph = _build_launch_graph(value)
        warnings = [
            line for file in list_parameter_files(value["config"]) for line in describe_unknown_nodes(file, graph)
        ]
        return [*(LogInfo(msg=f"warning: {line}") for line in warnings), *processes]

    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "detectors",
                default_value=detectors,
                description=f"Comma-separated detectors: {', '.join(DETECTOR_NODES)}. Ground segmentation and "
                "clustering use the parameters of the first one.",
            ),
            *(DeclareLaunchArgument(name, **options) for name, options in ARGUMENTS.items()),
            OpaqueFunction(function=make_actions),
        ]
    )


def find_argument_names() -> list[Any]:
    """Return the names of the arguments that were passed to the launch file that calls this function.

    They come from the command line or from the including file, as text or as launch substitutions.
    Only the IncludeLaunchDescription that loads the file knows them: the launch context mixes them
    with the launch configurations of all other files.
    """
    frame: Any = sys._getframe()
    while frame is not None:
        action = frame.f_locals.get("self")
        if isinstance(action, IncludeLaunchDescription):
            return [name for name, _ in action.launch_arguments]
        frame = frame.f_back
    return []


def reject_unknown_arguments(names: list[Any], context: Any, valid_names: Collection[str]) -> None:
    """Raise InputError for the first name that is not valid; the message suggests the closest valid name.

    names: text, or lists of launch substitutions.
    """
    for parts in names:
        name = "".join(
            part if isinstance(part, str) else context.perform_substitution(part)
            for part in (parts if isinstance(parts, list | tuple) else [parts])
        )
        if name in valid_names or name in LAUNCH_ARGUMENTS:
            continue
        if nodes := [node for node in NODES if name in find_node_parameters(node)]:
            raise InputError(
                f"'{name}' is not a launch argument but a parameter of "
                f"{', '.join(nodes)}; set it in a parameter file, config:=FILE"
            )
        raise make_unknown_name_error("launch argument", name, sorted(valid_names))


def create_nodes(value: dict[str, str], config_folder: Path) -> list[Node]:
    """Return one launch node per process, given the values of the launch arguments."""
    graph, detectors, single = _build_launch_graph(value), _parse_detectors(value), value["single"] == "true"
    prefix, user_files = value["name_prefix"], list_parameter_files(value["config"])
    files = {
        node: [_find_package_file(name, config_folder), *user_files]
        for name in detectors
        for node in (SINGLE_PROCESS_NODES if single else DETECTOR_NODES)[name]
    }
    files |= {node: [_find_package_file(detectors[0], config_folder), *user_files] for node in EXPERTS}
    files |= {node: [str(config_folder / f"{TRACKER}.param.yaml"), *user_files] for node in find_trackers(detectors)}
    topics = {make_relative(POINTS): value["points"], make_relative(ODOMETRY): value["odometry"]}
    viewer = [_make_rviz_node(value, config_folder)] if value["rviz"] == "true" else []
    common = {
        "package": "lidar_perception",
        "namespace": value["namespace"] or None,
        "output": "screen",
        "ros_arguments": ["--log-level", value["log_level"]],
        "respawn": value["respawn"] == "true",
        "respawn_delay": RESPAWN_DELAY_S,
    }
    nodes: list[dict[str, Any]] = [
        dict(
            executable=find_executable(base := node.removeprefix(prefix)),
            name=node,
            parameters=[
                *add_arguments(files[base], node, list_argument_parameters(value, base, detectors)),
                *(_list_expert_params(value, files) if base == "ground_segmentation" else ()),
            ],
            # A parameter file may make any node read odometry; other nodes ignore the remapping.
            remappings=[(old, topics.get(new, new)) for old, new in {**remap, **ODOMETRY_INPUT}.items()],
        )
        for node, remap in graph.items()
    ]
    if len(nodes) > 1 and runs_in_one_process(value["processes"]):
        words = [word for node in nodes for word in (SEPARATOR, *_list_arguments(**node))]
        return [*viewer, Node(executable=words[1], arguments=[*words[2:], SEPARATOR], exec_name="graph", **common)]
    return viewer + [Node(**node, **common) for node in nodes]


def _list_arguments(executable: str, name: str, parameters: list[Any], remappings: list[tuple[str, str]]) -> list[str]:
    """Return the command-line arguments of a node that shares its process, see nodes.main.run."""
    rules = [("__node", name), *remappings]
    files = [item if isinstance(item, str) else write_section(EVERY_NODE, values=item) for item in parameters]
    return [
        executable,
        "--ros-args",
        *(word for rule in rules for word in ("-r", ":=".join(rule))),
        *(word for file in files for word in ("--params-file", file)),
    ]


def _build_launch_graph(value: dict[str, str]) -> dict[str, dict[str, str]]:
    detectors, single = _parse_detectors(value), value["single"] == "true"
    tracking = value["tracking"] == "true" and not single
    return add_node_prefix(build_graph(detectors, single, tracking), value["name_prefix"])


def _find_package_file(detector: str, config_folder: Path) -> str:
    return str(config_folder / f"{CONFIGS[detector]}.param.yaml")


def _list_expert_params(value: dict[str, str], files: dict[str, list[str]]) -> list[dict[str, Any]]:
    """Return the parameters of ground_segmentation that follow from its detectors and are not set in a file.

    files: {node: its parameter files}
    """

    def read(node: str) -> dict[str, Any]:
        sections = [item for file in files[node] for item in read_sections(file).items()]
        return {
            key: v
            for section, values in sections
            if is_for(section, value["name_prefix"] + node)
            for key, v in values.items()
        }

    params, detectors = read("ground_segmentation"), _parse_detectors(value)
    given = set(params)
    for node in [f"{name}_detector" for name in detectors if name in NETWORKS]:
        params |= read(node) | list_argument_parameters(value, node, detectors)
    expert_params = {k: v for k, v in find_expert_params(detectors, params).items() if k not in given and v != "all"}
    return [expert_params] if expert_params else []


def _parse_detectors(value: dict[str, str]) -> list[str]:
    return split_detectors(value["detectors"])


def _make_rviz_node(value: dict[str, str], config_folder: Path) -> Node:
    """Return the RViz node, remapped to the topics of the launched nodes."""
    file = config_folder / "lidar_perception.rviz"
    frame = ["-f", value["rviz_frame"]] if value["rviz_frame"] else []
    remap = {topic: _rename_rviz_topic(topic, value) for _, topic in read_rviz_topics(file)}
    return Node(
        package="rviz2",
        executable="rviz2",
        name=value["name_prefix"] + "rviz",
        namespace=value["namespace"] or None,
        arguments=["-d", str(file), *frame],
        output="screen",
        parameters=[{"use_sim_time": value["use_sim_time"] == "true"}],
        remappings=[(old, new) for old, new in remap.items() if old != new],
    )


def read_rviz_topics(file: Path) -> list[tuple[str, str]]:
    """Return (class, topic) of each display and tool of an RViz file that has a topic."""
    manager = yaml.safe_load(file.read_text())["Visualization Manager"]
    return [
        (item["Class"], item["Topic"]["Value"]) for item in [*manager["Displays"], *manager["Tools"]] if "Topic" in item
    ]


def _rename_rviz_topic(topic: str, value: dict[str, str]) -> str:
    node, slash, rest = topic.partition("/")
    detectors, single = _parse_detectors(value), value["single"] == "true"
    if topic == make_relative(POINTS):
        return value["points"]
    if node == TRACKER:  # the tracker follows the first detector
        node = next(iter(SINGLE_PROCESS_NODES[detectors[0]] if single else find_trackers(detectors)))
    elif single and node in CANDIDATES_GRAPH:
        node = next(iter(SINGLE_PROCESS_CANDIDATES))
    is_ours = node in {*build_graph([*DETECTOR_NODES]), *find_trackers(detectors), *SINGLE_PROCESS_CANDIDATES}
    return (value["name_prefix"] if is_ours else "") + node + slash + rest
