"""What the launch files share: their arguments, and one process for each node."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription
from lidar_perception.nodes.graph import BEHIND, SINGLE, STAGES, graph_of, prefixed, relative
from lidar_perception.types import InputError
from lidar_perception.wire.topics import POINTS

CONFIGS = {"candidates": "perception", "pointpillars": "pointpillars", "pointnet": "pointnet"}
NETWORKS = ("pointpillars", "pointnet")  # as their groups of parameters

SWITCHES = dict(default_value="false", choices=["true", "false"])
ARGUMENTS = {
    "namespace": dict(default_value="", description="Of all nodes and topics, for one of several "
                      "sensors; /diagnostics, /tf and /clock stay outside."),
    "name_prefix": dict(default_value="", description="Before the name of each node."),
    "points": dict(default_value=relative(POINTS), description="The cloud's topic."),
    "reliability": dict(default_value="", description="auto, reliable or best_effort, for the "
                        "parameter input.reliability; empty: that of the parameter file."),
    "config": dict(default_value="", description="Parameter file of all nodes; empty: "
                   "config/*.param.yaml of each detector, and of the first for ground and "
                   "clusters."),
    "weights": dict(default_value="", description="Checkpoint of the network, with several "
                    "networks NAME=FILE,NAME=FILE; empty: that of the parameter file, or the one "
                    "that comes with the package."),
    "device": dict(default_value="", description="auto, cpu, cuda, cuda:N of the networks; empty: "
                   "that of the parameter file."),
    "single": dict(**SWITCHES, description="Each detector in one process, which finds ground and "
                   "clusters itself."),
    "rviz": dict(**SWITCHES, description="Start RViz with config/lidar_perception.rviz, in the "
                 "same namespace."),
    "rviz_frame": dict(default_value="", description="Fixed frame of RViz; empty: that of its "
                       "file, velodyne."),
    "use_sim_time": dict(**SWITCHES, description="Take the time from /clock."),
    "log_level": dict(default_value="info", description="debug, info, ..."),
}


def graph_launch(config_folder: Path, detectors: str) -> LaunchDescription:
    """Ground and clusters, once, and the detectors behind them: a list with commas, the default of
    the argument `detectors`. ARGUMENTS are the others."""

    def nodes(context: Any) -> list[Node]:
        return started({k: context.perform_substitution(LaunchConfiguration(k))
                        for k in ("detectors", *ARGUMENTS)}, config_folder)

    return LaunchDescription([
        DeclareLaunchArgument("detectors", default_value=detectors,
                              description=f"One or several of {','.join(BEHIND)}."),
        *(DeclareLaunchArgument(name, **what) for name, what in ARGUMENTS.items()),
        OpaqueFunction(function=nodes),
    ])


def started(value: dict[str, str], config_folder: Path) -> list[Node]:
    """The nodes that the values of the arguments ask for."""
    detectors = [name.strip() for name in value["detectors"].split(",") if name.strip()]
    if not detectors:
        raise InputError(f"detectors is empty; give one or several of {','.join(BEHIND)}")
    single, prefix = value["single"] == "true", value["name_prefix"]
    graph = prefixed(graph_of(detectors, single), prefix)
    owner = {prefix + node: name for name in reversed(detectors)
             for node in graph_of([name], single)}
    viewer = [_viewer(value, config_folder)] if value["rviz"] == "true" else []
    return viewer + [Node(
        package="lidar_perception", executable=node.removeprefix(prefix), name=node,
        namespace=value["namespace"] or None, output="screen",
        parameters=[value["config"] or str(config_folder / f"{CONFIGS[owner[node]]}.param.yaml"),
                    _given(value, owner[node], detectors)],
        remappings=[(a, value["points"] if b == relative(POINTS) else b)
                    for a, b in remap.items()],
        ros_arguments=["--log-level", value["log_level"]],
    ) for node, remap in graph.items()]


def _viewer(value: dict[str, str], config_folder: Path) -> Node:
    """RViz, its topics renamed as those of the nodes are."""
    file = config_folder / "lidar_perception.rviz"
    frame = ["-f", value["rviz_frame"]] if value["rviz_frame"] else []
    renamed = {topic: _shown(topic, value) for _, topic in rviz_topics(file)}
    return Node(
        package="rviz2", executable="rviz2", name=value["name_prefix"] + "rviz",
        namespace=value["namespace"] or None, arguments=["-d", str(file), *frame], output="screen",
        parameters=[{"use_sim_time": value["use_sim_time"] == "true"}],
        remappings=[(a, b) for a, b in renamed.items() if a != b])


def rviz_topics(file: Path) -> list[tuple[str, str]]:
    """(class, topic) of each display and tool of an RViz file that has a topic."""
    manager = yaml.safe_load(file.read_text())["Visualization Manager"]
    return [(each["Class"], each["Topic"]["Value"])
            for each in [*manager["Displays"], *manager["Tools"]] if "Topic" in each]


def _shown(topic: str, value: dict[str, str]) -> str:
    node, slash, rest = topic.partition("/")
    if topic == relative(POINTS):
        return value["points"]
    if value["single"] == "true" and node in STAGES:
        node = next(iter(SINGLE))
    ours = node in {*graph_of([*BEHIND]), *SINGLE}
    return (value["name_prefix"] if ours else "") + node + slash + rest


def _given(value: dict[str, str], detector: str, detectors: list[str]) -> dict[str, Any]:
    """Parameters that arguments set."""
    given: dict[str, Any] = {"use_sim_time": value["use_sim_time"] == "true"}
    if value["reliability"]:
        given["input.reliability"] = value["reliability"]
    if detector in NETWORKS:
        weights = _weights(value["weights"], [d for d in detectors if d in NETWORKS])
        for name, chosen in (("weights", weights.get(detector)), ("device", value["device"])):
            if chosen:
                given[f"{detector}.{name}"] = chosen
    return given


def _weights(text: str, networks: list[str]) -> dict[str, str]:
    """Network -> file, of FILE or NAME=FILE,NAME=FILE."""
    if not text:
        return {}
    if len(networks) == 1 and not text.startswith(f"{networks[0]}="):
        return {networks[0]: text}
    pairs = dict(part.partition("=")[::2] for part in text.split(","))
    if unknown := [name for name in pairs if name not in networks]:
        raise InputError(f"weights: '{unknown[0]}' is none of {', '.join(networks)}; with several "
                         "networks give NAME=FILE,NAME=FILE")
    return pairs
