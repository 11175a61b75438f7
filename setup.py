"""ament_python package, and an ordinary one for pip."""

import sys
from glob import glob
from pathlib import Path
from runpy import run_path

from setuptools import find_packages, setup

NAME = "lidar_perception"
NODES = list(run_path("lidar_perception/nodes/__init__.py")["NODES"])
README = Path(__file__).resolve().with_name("README.md")  # colcon links setup.py elsewhere


def node_executables() -> list[str]:
    """Copies of scripts/node under the nodes' names, for lib/lidar_perception of a pip install.

    `ros2 run` looks there and nowhere else. colcon puts the console scripts there by itself
    (setup.cfg), but pip puts them into bin.
    """
    if not {"bdist_wheel", "editable_wheel"} & set(sys.argv):
        return []
    folder = Path("build/node_executables")
    folder.mkdir(parents=True, exist_ok=True)
    for name in NODES:
        script = folder / name
        script.write_text(Path("scripts/node").read_text())
        script.chmod(0o755)
    return [str(folder / name) for name in NODES]


setup(
    name=NAME,
    version="0.1.0",
    description="LiDAR perception for ROS 2: ground, clusters, pedestrian candidates, learned "
                "detectors, tracks, a simulator and training",
    long_description=README.read_text(),
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    maintainer="lidar_perception maintainers",
    maintainer_email="maintainers@lidar-perception.invalid",
    python_requires=">=3.11,<3.13",
    packages=find_packages(include=["lidar_perception*", "msg_utils*"]),
    package_data={NAME: ["nodes/*.xml", "candidates/*.json", "*/*.html",
                         "simulation/sensors/*.yaml", "labeling/page/*", "detectors/*/weights/*",
                         "detectors/fused/*.json"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", glob("launch/*.launch.py")),
        (f"share/{NAME}/config", glob("config/*.*")),
        (f"share/{NAME}/config/sensors", glob("config/sensors/*")),
        (f"lib/{NAME}", node_executables()),
    ],
    install_requires=[
        "aiohttp>=3.9", "click>=8.1", "jinja2>=3.1", "matplotlib>=3.7", "lz4>=4.0", "mcap>=1.2",
        "numba>=0.59", "numpy>=1.26", "pypatchworkpp>=1.0", "pyyaml>=6", "rich>=13",
        "rosbags>=0.11.6", "ruamel.yaml.clib>=0.2.12", "safetensors>=0.4", "scikit-learn>=1.3",
        "scipy>=1.11", "threadpoolctl>=3.1", "torch>=2.2", "zstandard>=0.21",
    ],
    extras_require={
        "ros": ["ros-jazzy-rclpy[fastrtps]", "ros-jazzy-common-interfaces"],
        "test": ["pytest>=7.4", "hypothesis>=6.90", "mypy>=1.15", "opencv-python-headless>=4.8",
                 "playwright>=1.50", "pytest-cov>=7.0", "pytest-xdist>=3.7", "ruff>=0.9",
                 "setuptools>=70.1", "shapely>=2.0"],
        "distributed": ["distributed>=2024.1"],
        "odometry": ["kiss-icp>=1.2"],
        "onnx": ["onnx>=1.16", "onnxruntime>=1.18", "onnxscript>=0.2", "torch>=2.6"],
        "train": ["tensorboard>=2.15"],
        "benchmark": ["cloth-simulation-filter>=1.1.5", "dbscan>=1.0",
                      "opencv-python-headless>=4.8"],
    },
    entry_points={"console_scripts": [
        "lidar-perception = lidar_perception.cli.main:main",
        *(f"{name} = lidar_perception.nodes.main:main" for name in NODES),
    ]},
    zip_safe=False,
)
