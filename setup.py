"""ament_python package, and an ordinary one for pip."""

import os
import re
import subprocess
from glob import glob
from pathlib import Path
from runpy import run_path

from setuptools import Distribution, find_packages, setup

NAME = "lidar_perception"
ROOT = Path(__file__).resolve().parent  # colcon links setup.py elsewhere
VERSION = run_path("lidar_perception/__init__.py")["__version__"]


def find_repository_url() -> str:
    """Return the https address of the repository, or "" if it is unknown.

    It is LIDAR_REPOSITORY_URL or git's remote `origin`, so that the wheel of a fork links to the fork.
    """
    url = os.environ.get("LIDAR_REPOSITORY_URL", "")
    if not url and (ROOT / ".git").exists():
        remote = subprocess.run(
            ["git", "-C", str(ROOT), "config", "remote.origin.url"], capture_output=True, text=True, check=False
        )
        url = re.sub(r"^git@([^:]+):", r"https://\1/", remote.stdout.strip())
    return url.removesuffix(".git").rstrip("/") if url.startswith("https://") else ""


def make_index_page(text: str, url: str) -> str:
    """Return the README with absolute links, because a package index shows it outside the repository."""
    if not url:
        return text
    text = re.sub(r"(!\[[^\]]*\]\()(?!https?:)", rf"\1{url}/raw/main/", text)
    return re.sub(r"((?<!\!)\[[^\]]*\]\()(?!https?:|#)", rf"\1{url}/blob/main/", text)


def list_project_urls(url: str) -> dict[str, str]:
    pages = {
        "Source": "",
        "Documentation": "/tree/main/docs",
        "Issues": "/issues",
        "Changelog": "/blob/main/CHANGELOG.md",
    }
    return {name: url + path for name, path in pages.items()} if url else {}


class WithDataFiles(Distribution):
    """Distribution whose editable installation includes the data files, which ros2 run and ros2 launch need.

    For an editable installation, setuptools 84 reads the attribute `has_data` (_run_install in
    setuptools/command/editable_wheel.py), but its own class has only has_data_files.
    """

    has_data = Distribution.has_data_files


URL = find_repository_url()

setup(
    distclass=WithDataFiles,
    name=NAME,
    version=VERSION,
    description="LiDAR perception for ROS 2: ground, clusters, pedestrian candidates, learned "
    "detectors, tracks, a simulator and training",
    long_description=make_index_page((ROOT / "README.md").read_text(), URL),
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    url=URL or None,
    project_urls=list_project_urls(URL),
    maintainer="lidar_perception maintainers",
    keywords=[
        "lidar",
        "point cloud",
        "3D object detection",
        "ROS 2",
        "PointPillars",
        "tracking",
        "KITTI",
        "ground segmentation",
        "clustering",
        "pedestrian detection",
    ],
    classifiers=[
        "Development Status :: 4 - Beta",
        "Intended Audience :: Developers",
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3.11",
        "Programming Language :: Python :: 3.12",
        "Topic :: Scientific/Engineering :: Artificial Intelligence",
        "Topic :: Scientific/Engineering :: Image Recognition",
        "Typing :: Typed",
    ],
    python_requires=">=3.11,<3.13",
    packages=find_packages(include=["lidar_perception*", "lidar_studio*", "msg_utils*"]),
    package_data={
        NAME: [
            "py.typed",
            "nodes/*.xml",
            "candidates/*.json",
            "simulation/sensors/*.yaml",
            "detectors/fused/*.json",
            "detectors/pointnet/weights/*",
            "detectors/pointpillars/weights/pointpillars_v4_*",
        ],
        "lidar_studio": ["py.typed", "page/*"],
        "msg_utils": ["py.typed"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", glob("launch/*.launch.py")),
        (f"share/{NAME}/config", glob("config/*.*")),
        (f"share/{NAME}/config/sensors", glob("config/sensors/*")),
        (f"lib/{NAME}", glob("scripts/nodes/*")),  # the only folder that ros2 run searches
    ],
    install_requires=[
        "click>=8.1",
        "matplotlib>=3.7",
        "lz4>=4.0",
        "mcap>=1.2",
        "numba>=0.59",
        "numpy>=1.26",
        "pillow>=9.4",
        "pyyaml>=6",
        "rich>=13",
        "rosbags>=0.11.6",
        "ruamel.yaml.clib>=0.2.12",
        "safetensors>=0.4",
        "scikit-learn>=1.3",
        "scipy>=1.11",
        "threadpoolctl>=3.1",
        "torch>=2.2",
        "zstandard>=0.21",
    ],
    extras_require={
        "ros": ["ros-jazzy-rclpy[fastrtps]", "ros-jazzy-common-interfaces"],
        "test": [
            "pytest>=7.4",
            "hypothesis>=6.90",
            "mypy>=1.15",
            "opencv-python-headless>=4.8",
            "playwright>=1.50",
            "pypatchworkpp>=1.0",
            "pytest-cov>=7.0",
            "pytest-xdist>=3.7",
            "ruff>=0.9",
            "setuptools>=70.1",
            "shapely>=2.0",
        ],
        "studio": ["aiohttp>=3.9"],
        "docs": ["mkdocs-material>=9.5", "mkdocstrings[python]>=0.26"],
        "distributed": ["distributed>=2024.1"],
        "odometry": ["kiss-icp>=1.2"],
        "onnx": ["onnx>=1.16", "onnxruntime>=1.18", "onnxscript>=0.2", "torch>=2.6"],
        "train": ["tensorboard>=2.15"],
        "video": ["av>=14"],
        "benchmark": [
            "cloth-simulation-filter>=1.1.5",
            "dbscan>=1.0",
            "opencv-python-headless>=4.8",
            "pypatchworkpp>=1.0",
        ],
    },
    entry_points={"console_scripts": ["lidar-perception = lidar_perception.cli.entry:main"]},
    zip_safe=False,
)
