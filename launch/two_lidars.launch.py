"""Launch one graph for each of two sensors, each in its own namespace.

    ros2 launch lidar_perception two_lidars.launch.py left:=/lidar_left/points \
        right:=/lidar_right/points detectors:=pointpillars
"""

from pathlib import Path

from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

from launch import LaunchDescription
from lidar_perception.nodes.launching import ARGUMENTS, find_argument_names, reject_unknown_arguments

GRAPH = Path(__file__).resolve().parent / "detectors.launch.py"
SIDES = ("left", "right")
SHARED = {
    "detectors": "candidates",
    "single": "false",
    "tracking": "false",
    "processes": "auto",
    "respawn": "false",
    "rviz": "false",
    "rviz_frame": "",
    "base_frame": "",
    "target_frame": "",
    "deskew": "",
    "range": "",
    "odometry": "odom",
    "use_sim_time": "",
    "log_level": "info",
}


def generate_launch_description():
    argument_names = find_argument_names()
    valid_names = {*SIDES, *SHARED, *ARGUMENTS} - {"namespace", "points"}
    return LaunchDescription(
        [
            OpaqueFunction(function=lambda context: reject_unknown_arguments(argument_names, context, valid_names)),
            *(
                DeclareLaunchArgument(
                    side,
                    default_value="points",
                    description=f"Topic of the clouds, in the namespace {side} unless it starts with /.",
                )
                for side in SIDES
            ),
            *(
                DeclareLaunchArgument(name, default_value=value, description="See detectors.launch.py.")
                for name, value in SHARED.items()
            ),
            *(
                IncludeLaunchDescription(
                    PythonLaunchDescriptionSource(str(GRAPH)),
                    launch_arguments={
                        "namespace": side,
                        "points": LaunchConfiguration(side),
                        **{name: LaunchConfiguration(name) for name in SHARED},
                    }.items(),
                )
                for side in SIDES
            ),
        ]
    )
