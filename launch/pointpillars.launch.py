"""Cars, pedestrians and cyclists in a live or replayed cloud, by EG-PointPillars.

    ros2 launch lidar_perception pointpillars.launch.py points:=/velodyne_points
"""

from pathlib import Path

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription
from lidar_perception.nodes.graph import DETECTION, SINGLE_DETECTION
from lidar_perception.topics import POINTS

CONFIG = Path(__file__).resolve().parents[1] / "config" / "pointpillars.param.yaml"


def nodes(context):
    value = {k: context.perform_substitution(LaunchConfiguration(k))
             for k in ("points", "weights", "device", "config", "single", "use_sim_time",
                       "log_level")}
    graph = SINGLE_DETECTION if value["single"] == "true" else DETECTION
    given = {f"detection.{k}": value[k] for k in ("weights", "device") if value[k]}
    return [Node(
        package="lidar_perception", executable=name, name=name, output="screen",
        parameters=[value["config"], {**given, "use_sim_time": value["use_sim_time"] == "true"}],
        remappings=[(a, value["points"] if b == POINTS else b) for a, b in remap.items()],
        ros_arguments=["--log-level", value["log_level"]],
    ) for name, remap in graph.items()]


def generate_launch_description():
    return LaunchDescription([
        DeclareLaunchArgument("points", default_value=POINTS, description="The cloud's topic."),
        DeclareLaunchArgument("weights", default_value="", description="Checkpoint; empty: that "
                              "of the parameter file, or the one that comes with the package."),
        DeclareLaunchArgument("device", default_value="", description="auto, cpu, cuda, cuda:N; "
                              "empty: that of the parameter file."),
        DeclareLaunchArgument("config", default_value=str(CONFIG), description="Parameter file."),
        DeclareLaunchArgument("single", default_value="false", choices=["true", "false"],
                              description="The detector alone, which then finds ground and "
                              "clusters itself."),
        DeclareLaunchArgument("use_sim_time", default_value="false", choices=["true", "false"],
                              description="Take the time from /clock."),
        DeclareLaunchArgument("log_level", default_value="info", description="debug, info, ..."),
        OpaqueFunction(function=nodes),
    ])
