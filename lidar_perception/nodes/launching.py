"""What the launch files share: their arguments, and one process for each node."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription
from lidar_perception.nodes.graph import (
    BEHIND,
    ODOMETRY_IN,
    TRACKER,
    executable_of,
    graph_of,
    prefixed,
    relative,
    trackers_of,
)
from lidar_perception.param_fields import flatten
from lidar_perception.tracking.params import tracking_of
from lidar_perception.types import InputError
from lidar_perception.wire.topics import ODOMETRY, POINTS

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
    "tracking": dict(**SWITCHES, description="Tracks of what each detector finds: a tracker behind "
                     "each; with `single` in the detector's process."),
    "odometry": dict(default_value=relative(ODOMETRY), description="Topic of the odometry, for "
                     "the trackers."),
    "single": dict(**SWITCHES, description="Each detector in one process, which finds ground and "
                   "clusters itself."),
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
    tracking = value["tracking"] == "true"
    graph = prefixed(graph_of(detectors, single, tracking and not single), prefix)
    owner = {prefix + node: name for name in reversed(detectors)
             for node in graph_of([name], single)}
    trackers = {prefix + node: name for node, name in trackers_of(detectors).items()}
    topics = {relative(POINTS): value["points"], relative(ODOMETRY): value["odometry"]}

    def parameters(node: str) -> list[Any]:
        detector = trackers.get(node) or owner[node]
        name = TRACKER if node in trackers else CONFIGS[detector]
        file = value["config"] or str(config_folder / f"{name}.param.yaml")
        if node in trackers:
            return [_tracked(detector), file, _given(value, "", detectors)]
        return [file, _given(value, detector, detectors, tracking and single)]

    def remapped(node: str) -> dict[str, str]:
        in_process = ODOMETRY_IN if tracking and single else {}
        return {a: topics.get(b, b) for a, b in {**graph[node], **in_process}.items()}

    return [Node(
        package="lidar_perception", executable=executable_of(node.removeprefix(prefix)), name=node,
        namespace=value["namespace"] or None, output="screen", parameters=parameters(node),
        remappings=[*remapped(node).items()], ros_arguments=["--log-level", value["log_level"]],
    ) for node in graph]


def _tracked(detector: str) -> dict[str, Any]:
    """What the tracker behind a detector has instead of the defaults; files stand above it."""
    default = flatten(tracking_of(""))
    return {f"tracking.{name}": number for name, number in flatten(tracking_of(detector)).items()
            if number != default[name]}


def _given(value: dict[str, str], detector: str, detectors: list[str],
           tracking: bool = False) -> dict[str, Any]:
    """Parameters that arguments set."""
    given: dict[str, Any] = {"use_sim_time": value["use_sim_time"] == "true"}
    if tracking:
        given["tracking.enabled"] = True
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
