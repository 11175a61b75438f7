"""Cars, pedestrians and cyclists among the clusters of a live or replayed cloud, by PointNet.

    ros2 launch lidar_perception pointnet.launch.py points:=/velodyne_points
"""

from pathlib import Path

from lidar_perception.nodes.graph import POINTNET, SINGLE_POINTNET
from lidar_perception.nodes.launching import detector_launch

CONFIG = Path(__file__).resolve().parents[1] / "config" / "pointnet.param.yaml"


def generate_launch_description():
    return detector_launch(POINTNET, SINGLE_POINTNET, CONFIG, "pointnet")
