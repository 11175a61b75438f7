"""Launch the PointNet detector of cars, pedestrians and cyclists; see detectors.launch.py.

ros2 launch lidar_perception pointnet.launch.py points:=/velodyne_points
"""

from pathlib import Path

from lidar_perception.nodes.launching import make_launch_description

CONFIGS = Path(__file__).resolve().parents[1] / "config"


def generate_launch_description():
    return make_launch_description(CONFIGS, "pointnet")
