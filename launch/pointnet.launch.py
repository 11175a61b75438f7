"""Cars, pedestrians and cyclists among the clusters of a cloud, by PointNet;
a case of detectors.launch.py.

    ros2 launch lidar_perception pointnet.launch.py points:=/velodyne_points
"""

from pathlib import Path

from lidar_perception.nodes.launching import graph_launch

CONFIGS = Path(__file__).resolve().parents[1] / "config"


def generate_launch_description():
    return graph_launch(CONFIGS, "pointnet")
