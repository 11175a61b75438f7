"""Cars, pedestrians and cyclists by all sources together; a case of detectors.launch.py.

    ros2 launch lidar_perception fused.launch.py points:=/velodyne_points
"""

from pathlib import Path

from lidar_perception.nodes.launching import graph_launch

CONFIGS = Path(__file__).resolve().parents[1] / "config"


def generate_launch_description():
    return graph_launch(CONFIGS, "fused")
