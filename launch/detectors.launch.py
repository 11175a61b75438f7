"""Launch ground segmentation, clustering and any of the detectors for one sensor.

    ros2 launch lidar_perception detectors.launch.py detectors:=pointpillars,candidates
    ros2 launch lidar_perception detectors.launch.py detectors:=pointpillars tracking:=true

For two sensors start it twice, with namespace:=left and namespace:=right.
"""

from pathlib import Path

from lidar_perception.nodes.launching import make_launch_description

CONFIGS = Path(__file__).resolve().parents[1] / "config"


def generate_launch_description():
    return make_launch_description(CONFIGS, "fused")
