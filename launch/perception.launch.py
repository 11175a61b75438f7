"""The candidate pipeline on a live or replayed cloud.

    ros2 launch lidar_perception perception.launch.py points:=/velodyne_points
"""

from pathlib import Path

from lidar_perception.nodes.graph import SINGLE, STAGES
from lidar_perception.nodes.launching import graph_launch

CONFIG = Path(__file__).resolve().parents[1] / "config" / "perception.param.yaml"


def generate_launch_description():
    return graph_launch(STAGES, SINGLE, CONFIG, "All stages in one process.")
