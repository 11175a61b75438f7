"""Cars, pedestrians and cyclists in a live or replayed cloud, by EG-PointPillars;
a case of detectors.launch.py.

    ros2 launch lidar_perception pointpillars.launch.py points:=/velodyne_points
"""

from pathlib import Path

from lidar_perception.nodes.launching import graph_launch

CONFIGS = Path(__file__).resolve().parents[1] / "config"


def generate_launch_description():
    return graph_launch(CONFIGS, "pointpillars")
