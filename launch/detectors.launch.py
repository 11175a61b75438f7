"""Ground and clusters of a live or replayed cloud, once, and any of the detectors behind them.

    ros2 launch lidar_perception detectors.launch.py detectors:=pointpillars,candidates
    ros2 launch lidar_perception detectors.launch.py detectors:=pointpillars tracking:=true

Two sensors: one launch for each, with namespace:=left and namespace:=right.
"""

from pathlib import Path

from lidar_perception.nodes.launching import graph_launch

CONFIGS = Path(__file__).resolve().parents[1] / "config"


def generate_launch_description():
    return graph_launch(CONFIGS, "fused")
