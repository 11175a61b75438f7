"""Cars, pedestrians and cyclists in a live or replayed cloud, by EG-PointPillars.

    ros2 launch lidar_perception pointpillars.launch.py points:=/velodyne_points
"""

from pathlib import Path

from lidar_perception.nodes.graph import POINTPILLARS, SINGLE_POINTPILLARS
from lidar_perception.nodes.launching import detector_launch

CONFIG = Path(__file__).resolve().parents[1] / "config" / "pointpillars.param.yaml"


def generate_launch_description():
    return detector_launch(POINTPILLARS, SINGLE_POINTPILLARS, CONFIG, "pointpillars")
