"""Support for launch_testing, to test launch files of this package on a private ROS domain.

It needs launch_testing and launch_ros of ROS 2. Use Peer in the tests to wait for messages.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from lidar_perception.candidates.warm_up import warm_up
from lidar_perception.nodes.graph import reserve_domain
from lidar_perception.nodes.shared_memory import use_large_shared_memory
from lidar_perception.types import InputError


def include_launch_file(name: str = "detectors", **arguments: Any) -> Any:
    """Return the launch action that includes launch/NAME.launch.py of this package.

    Example: include_launch_file(detectors="pointpillars", points="/front/points").

    Raises:
        InputError: launch is not installed, ROS does not find the package, or the launch file does
            not exist.
    """
    try:
        from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
        from launch.actions import IncludeLaunchDescription
        from launch.launch_description_sources import PythonLaunchDescriptionSource
    except ModuleNotFoundError as error:
        raise _make_missing_package_error(error) from None
    try:
        share_folder = Path(get_package_share_directory("lidar_perception"))
    except PackageNotFoundError:
        raise InputError(
            "ROS does not find the package lidar_perception; source the workspace in which it was "
            "built, or add the prefix in which pip installed it to AMENT_PREFIX_PATH"
        ) from None
    path = share_folder / "launch" / f"{name}.launch.py"
    if not path.is_file():
        available = ", ".join(sorted(p.name.split(".")[0] for p in path.parent.glob("*.launch.py")))
        raise InputError(f"unknown launch file '{name}'; choose from {available}")
    return IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(path)),
        launch_arguments=[
            (key, str(value).lower() if isinstance(value, bool) else str(value)) for key, value in arguments.items()
        ],
    )


def make_description(*actions: Any) -> Any:
    """Make the return value of generate_test_description(): the actions, then ReadyToTest.

    This process and the programs that it starts are also moved to a private ROS domain, limited to
    this machine, so that a test never communicates with a robot.

    Raises:
        InputError: launch_testing is not installed.
    """
    try:
        from launch.launch_description import LaunchDescription
        from launch_testing.actions import ReadyToTest
    except ModuleNotFoundError as error:
        raise _make_missing_package_error(error) from None
    os.environ.update(ROS_DOMAIN_ID=str(reserve_domain()), ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")
    use_large_shared_memory()
    warm_up()  # compile here, because compilation in a node could take longer than a timeout
    return LaunchDescription([*actions, ReadyToTest()])


def _make_missing_package_error(error: ModuleNotFoundError) -> InputError:
    package = str(error.name).partition(".")[0].replace("_", "-")
    return InputError(
        f"{error.name} is not installed; install ros-jazzy-{package}, or use pytest without "
        "launch_testing, see docs/how-to/test-your-stack.md"
    )
