"""What the launch files of a graph share: their arguments, and one process for each node."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription
from lidar_perception.wire.topics import POINTS

Graph = Mapping[str, Mapping[str, str]]  # node -> remapping of its topics, see graph.py


def graph_launch(graph: Graph, single: Graph, config: Path, single_means: str,
                 parameters: Mapping[str, tuple[str, str]] | None = None) -> LaunchDescription:
    """The nodes of a graph, or with single:=true of the other one, with the parameters of a file.

    parameters: launch argument -> name of a parameter that it sets where it is not empty, and
    what it is.
    """
    parameters = parameters or {}

    def nodes(context: Any) -> list[Node]:
        value = {k: context.perform_substitution(LaunchConfiguration(k))
                 for k in ("points", *parameters, "config", "single", "use_sim_time", "log_level")}
        given = {name: value[k] for k, (name, _) in parameters.items() if value[k]}
        given["use_sim_time"] = value["use_sim_time"] == "true"
        return [Node(
            package="lidar_perception", executable=name, name=name, output="screen",
            parameters=[value["config"], given],
            remappings=[(a, value["points"] if b == POINTS else b) for a, b in remap.items()],
            ros_arguments=["--log-level", value["log_level"]],
        ) for name, remap in (single if value["single"] == "true" else graph).items()]

    return LaunchDescription([
        DeclareLaunchArgument("points", default_value=POINTS, description="The cloud's topic."),
        *(DeclareLaunchArgument(k, default_value="", description=what)
          for k, (_, what) in parameters.items()),
        DeclareLaunchArgument("config", default_value=str(config), description="Parameter file."),
        DeclareLaunchArgument("single", default_value="false", choices=["true", "false"],
                              description=single_means),
        DeclareLaunchArgument("use_sim_time", default_value="false", choices=["true", "false"],
                              description="Take the time from /clock."),
        DeclareLaunchArgument("log_level", default_value="info", description="debug, info, ..."),
        OpaqueFunction(function=nodes),
    ])


def detector_launch(graph: Graph, single: Graph, config: Path, group: str) -> LaunchDescription:
    """The graph of a detector whose network has this group of parameters."""
    return graph_launch(
        graph, single, config,
        "The detector alone, which then finds ground and clusters itself.",
        {"weights": (f"{group}.weights", "Checkpoint; empty: that of the parameter file, or the "
                     "one that comes with the package."),
         "device": (f"{group}.device", "auto, cpu, cuda, cuda:N; empty: that of the parameter "
                    "file.")})
