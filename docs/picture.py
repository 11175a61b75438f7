"""Makes docs/images/scene.png, a simulated scan with its ground, its clusters and the boxes of the
PointPillars v4 that comes with the package, in perspective, and docs/images/look.png, the same as
config/lidar_perception.rviz and config/foxglove_layout.json show it: python docs/picture.py
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import find_candidates
from lidar_perception.candidates.seed_sources import fixed_seed
from lidar_perception.candidates.seeds import load_seed
from lidar_perception.candidates.segmented import Segmented
from lidar_perception.clustering.cluster import cluster
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.pointpillars.params import DetectorParams
from lidar_perception.ground.segment import segment_ground
from lidar_perception.scoring.scene_view import View, draw_scene, render
from lidar_perception.simulation.drive import scan_at
from lidar_perception.simulation.scene import Streets
from lidar_perception.simulation.sensor import HDL64E
from lidar_perception.types import CLASSES, Detections
from msg_utils.markers import COLORS

SEED, STREETS = 9, Streets("zone", people=3.0)
VIEW = View(eye=(-9.0, -4.5, 5.2), target=(14.0, 1.6, -0.9), fov=58.0, width=1600, height=720)
LOOK = View(eye=(-12.0, -6.0, 8.0), target=(12.0, 1.0, -1.2), fov=60.0, width=1600, height=800)
FOLDER = Path(__file__).parent / "images"
GROUND = np.array([92, 120, 158]) / 255  # as config/lidar_perception.rviz has it


def make(folder: Path = FOLDER) -> None:
    """Simulate the scan, run the package on it, write the pictures."""
    frame = scan_at(SEED, 0, HDL64E, STREETS).frame
    params = DetectorParams()
    found = open_detector()(frame).detections
    ground = segment_ground(frame, params.ground)
    cluster_ids = np.zeros(len(frame), np.int32)
    cluster_ids[~ground] = cluster(frame.xyz[~ground], params.clustering)
    draw_scene(folder / "scene.png", frame.xyz, ground, cluster_ids, found.boxes, found.class_ids,
               view=VIEW)
    template = load_seed(PipelineParams().seed.file)
    segmented, candidates = find_candidates(frame, fixed_seed(template))
    draw_look(folder / "look.png", segmented, [found, candidates.final])


def draw_look(path: Path, segmented: Segmented, shown: list[Detections]) -> None:
    """The displays that are on in the layouts: clusters by id, the ground, and detections in the
    colours of their markers."""
    colors = plt.get_cmap("turbo")(segmented.cluster_ids / segmented.cluster_ids.max())[:, :3]
    colors[segmented.ground] = GROUND
    boxes = np.concatenate([found.boxes for found in shown])
    names = [CLASSES[i] for found in shown for i in found.class_ids]
    plt.imsave(path, render(LOOK, segmented.xyz, colors, boxes,
                            np.array([COLORS[name] for name in names])))


if __name__ == "__main__":
    make(*map(Path, sys.argv[1:]))
