"""Launch one graph for each of two sensors, each in its own namespace.

    ros2 launch lidar_perception two_lidars.launch.py left:=/lidar_left/points \
        right:=/lidar_right/points detectors:=pointpillars

The other arguments of detectors.launch.py are valid for both sensors.
"""

from pathlib import Path

from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

from launch import LaunchDescription
from lidar_perception.nodes.launching import ARGUMENTS, find_argument_names, reject_unknown_arguments

GRAPH = Path(__file__).resolve().parent / "detectors.launch.py"
SIDES = {
    side: dict(
        default_value="points", description=f"Topic of the clouds, in the namespace {side} unless it starts with /."
    )
    for side in ("left", "right")
}
SHARED = {
    "detectors": dict(default_value="candidates", description="See detectors.launch.py."),
    **{name: options for name, options in ARGUMENTS.items() if name not in ("namespace", "points")},
}


def generate_launch_description():
    argument_names = find_argument_names()
    return LaunchDescription(
        [
            OpaqueFunction(
                function=lambda context: reject_unknown_arguments(argument_names, context, {**SIDES, **SHARED})
            ),
            *(DeclareLaunchArgument(name, **options) for name, options in {**SIDES, **SHARED}.items()),
            *(
                IncludeLaunchDescription(
                    PythonLaunchDescriptionSource(str(GRAPH)),
                    launch_arguments={"namespace": side, "points": LaunchConfiguration(side)}.items(),
                )
                for side in SIDES
            ),
        ]
    )
