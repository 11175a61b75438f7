"""The pictures of the README and of look.md, on a simulated scan: python docs/picture.py"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection, PolyCollection

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.candidates.pipeline import find_candidates
from lidar_perception.candidates.seed_sources import fixed_seed
from lidar_perception.candidates.seeds import load_seed
from lidar_perception.clustering.cluster import cluster
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.pointpillars.params import DetectorParams
from lidar_perception.geometry import box_corners, points_in_box
from lidar_perception.ground.segment import segment_ground
from lidar_perception.simulation.drive import scan_at
from lidar_perception.simulation.scene import Scenes
from lidar_perception.simulation.sensor import HDL64E
from lidar_perception.types import CLASSES
from msg_utils.markers import COLORS


@dataclass(frozen=True)
class View:
    """A pinhole camera, in the frame of the points: metres, pixels, degrees from edge to edge."""

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    fov: float
    width: int
    height: int
    near: float = 0.3

    @property
    def focal(self) -> float:
        """Pixels."""
        return self.width / 2 / np.tan(np.radians(self.fov) / 2)

    def project(self, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (..., 2), column and row, and metres ahead of the eye (...) of points (..., 3)."""
        ahead = np.subtract(self.target, self.eye)
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        seen = (xyz - np.array(self.eye)) @ np.stack([right, np.cross(ahead, right), ahead]).T
        depth = np.maximum(seen[..., 2], self.near)[..., None]
        centre = [self.width / 2, self.height / 2]
        return seen[..., :2] / depth * self.focal + centre, seen[..., 2]


FOLDER = Path(__file__).parent / "images"
SEED, STREETS = 9, Scenes("zone", people=3.0)
README = View(eye=(-9.0, -4.5, 5.2), target=(14.0, 1.6, -0.9), fov=58.0, width=1600, height=720)
LOOK = View(eye=(-12.0, -6.0, 8.0), target=(12.0, 1.0, -1.2), fov=60.0, width=1600, height=800)
POINT = 0.024  # a point's radius in metres

EDGES = [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6],
         [3, 7]]
FACES = [[0, 3, 7, 4], [1, 2, 6, 5], [0, 1, 5, 4], [2, 3, 7, 6], [4, 5, 6, 7]]  # the front first
SKY, FLOOR = (0.035, 0.05, 0.085), (0.075, 0.095, 0.14)
GROUND, REST = (0.36, 0.47, 0.62), (0.55, 0.60, 0.68)  # as config/lidar_perception.rviz has them
# Neighbouring clusters differ; muted, so that boxes stand out.
CLUSTERS = np.array([
    [0.56, 0.47, 0.86], [0.33, 0.65, 0.62], [0.82, 0.56, 0.66], [0.50, 0.68, 0.38],
    [0.38, 0.56, 0.85], [0.80, 0.65, 0.42], [0.68, 0.42, 0.68], [0.42, 0.70, 0.80],
    [0.76, 0.50, 0.44], [0.58, 0.62, 0.46]])
CLASS_COLORS = {"Car": (0.20, 0.80, 1.00), "Pedestrian": (1.00, 0.42, 0.32),
                "Cyclist": (1.00, 0.82, 0.22)}


def draw(path: Path, view: View, xyz: np.ndarray, colors: np.ndarray, boxes: np.ndarray,
         box_colors: np.ndarray, legend: dict[str, tuple] | None = None) -> None:
    """Draw from far to near: the points behind a box, its faces, what is before it; edges last.
    colors (N, 3) and box_colors (B, 3) are RGB in 0..1; legend is name -> colour."""
    pixels, depth = view.project(xyz.astype(float))
    order = np.argsort(-depth)
    order = order[depth[order] > view.near]

    figure = plt.figure(figsize=(view.width / 100, view.height / 100), dpi=100)
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, view.width), ylim=(view.height, 0))
    axes.axis("off")
    axes.imshow(np.linspace(SKY, FLOOR, view.height)[:, None],
                extent=(0, view.width, view.height, 0), aspect="auto")

    def draw_points(rows: np.ndarray, layer: int) -> None:
        radius = np.clip(POINT * view.focal / depth[rows], 0.6, 2.2)
        axes.scatter(*pixels[rows].T, s=(2 * radius * 0.72) ** 2, linewidths=0, zorder=layer,
                     c=np.column_stack([colors[rows], np.exp(-depth[rows] / 110)]))

    ends, ahead = view.project(box_corners(boxes.astype(float)))
    far_first = np.argsort(-ahead.mean(axis=1))
    limits = [np.inf, *ahead.mean(axis=1)[far_first], view.near]
    for layer, (far, near) in enumerate(pairwise(limits)):
        draw_points(order[(depth[order] <= far) & (depth[order] > near)], 2 * layer)
        if layer < len(boxes):
            k = far_first[layer]
            axes.add_collection(PolyCollection(
                [ends[k][face] for face in FACES], zorder=2 * layer + 1,
                facecolors=[(*box_colors[k], 0.07 if i else 0.38) for i in range(len(FACES))]))
            axes.add_collection(LineCollection(ends[k][EDGES], colors=[box_colors[k]],
                                               linewidths=1.1, zorder=2 * len(limits)))
    for i, (name, color) in enumerate((legend or {}).items()):
        figure.text(0.985, 0.955 - i * 0.05, name, ha="right", va="center", fontsize=15,
                    color=color)
    figure.savefig(path)
    plt.close(figure)


def make(folder: Path = FOLDER) -> None:
    """Simulate the scan, run the package on it, write the pictures."""
    frame = scan_at(SEED, 0, HDL64E, STREETS).frame
    params = DetectorParams()
    found = open_detector("pointpillars")(frame).detections
    ground = segment_ground(frame, params.ground)
    cluster_ids = np.zeros(len(frame), np.int32)
    cluster_ids[~ground] = cluster(frame.xyz[~ground], params.clustering)
    colors = np.where(ground[:, None], GROUND, REST)
    clustered = (cluster_ids > 0) & ~ground
    colors[clustered] = CLUSTERS[cluster_ids[clustered] * 7 % len(CLUSTERS)]
    box_colors = np.array([CLASS_COLORS[CLASSES[i]] for i in found.class_ids])
    for box, color in zip(found.boxes, box_colors):
        colors[points_in_box(frame.xyz, box, 0.1) & ~ground] = 0.45 + 0.55 * color
    draw(folder / "scene.png", README, frame.xyz, colors, found.boxes, box_colors, CLASS_COLORS)

    # The displays that are on in the layouts: clusters by id, the ground, and detections in the
    # colours of their markers.
    template = load_seed(PipelineParams().seed.file)
    segmented, candidates = find_candidates(frame, fixed_seed(template))
    colors = plt.get_cmap("turbo")(segmented.cluster_ids / segmented.cluster_ids.max())[:, :3]
    colors[segmented.ground] = GROUND
    shown = [found, candidates.final]
    draw(folder / "look.png", LOOK, segmented.xyz, colors,
         np.concatenate([each.boxes for each in shown]),
         np.array([COLORS[CLASSES[i]] for each in shown for i in each.class_ids]))


if __name__ == "__main__":
    make()
