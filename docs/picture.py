"""Makes docs/images/scene.png, a simulated scan with its ground, its clusters and the boxes of the
PointPillars v4 that comes with the package, in perspective: python docs/picture.py
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from lidar_perception.clustering.cluster import cluster
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.pointpillars.params import DetectorParams
from lidar_perception.ground.segment import segment_ground
from lidar_perception.scoring.scene_view import View, draw_scene
from lidar_perception.simulation.drive import scan_at
from lidar_perception.simulation.scene import Streets
from lidar_perception.simulation.sensor import HDL64E

SEED, STREETS = 9, Streets("zone", people=3.0)
VIEW = View(eye=(-9.0, -4.5, 5.2), target=(14.0, 1.6, -0.9), fov=58.0, width=1600, height=720)
PICTURE = Path(__file__).parent / "images" / "scene.png"


def make(path: Path = PICTURE) -> None:
    """Simulate the scan, run the package on it, write the picture."""
    frame = scan_at(SEED, 0, HDL64E, STREETS).frame
    params = DetectorParams()
    found = open_detector()(frame).detections
    ground = segment_ground(frame, params.ground)
    cluster_ids = np.zeros(len(frame), np.int32)
    cluster_ids[~ground] = cluster(frame.xyz[~ground], params.clustering)
    draw_scene(path, frame.xyz, ground, cluster_ids, found.boxes, found.class_ids, view=VIEW)


if __name__ == "__main__":
    make(*map(Path, sys.argv[1:]))
